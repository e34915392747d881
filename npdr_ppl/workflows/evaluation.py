"""How far a model at given parameters is from measured rollouts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts, stitch
from npdr_ppl.workflows.binding import BindingOptions

__all__ = ["Replay", "nominal_parameters", "replay", "residual_noise", "score"]


@dataclass(frozen=True)
class Replay:
    """Recorded actions replayed through a model, noise-free.

    Attributes:
        trajectory: Readings after each step, ``(n, S, K, C)``.
        inputs: The segments.
        channel_names: Names of the C measured channels.
    """

    trajectory: Tensor
    inputs: Inputs
    channel_names: tuple[str, ...]

    def series(self) -> list[Tensor]:
        """Returns the states before each step, one ``(n, T, C)`` per rollout."""
        return stitch(self.trajectory, self.inputs, self.channel_names)


def replay(
    model: Callable[..., Any],
    rollouts: Rollouts,
    parameters: Mapping[str, Tensor],
    options: BindingOptions,
) -> Replay:
    """Replays recorded actions through a model with one black-box site.

    Args:
        model: The Pyro model.
        rollouts: The recording.
        parameters: Values ``(n,) + site.shape`` by latent site.
        options: Segments, initial states and precision.

    Raises:
        DataError: The model has several black-box sites, or no channel was measured.
    """
    inputs = rollouts.inputs(options.segment_length, options.initial_state, dtype=options.dtype)
    prior = Prior(with_noise(model, None), (inputs,))
    if len(prior.black_boxes) != 1:
        raise DataError(f"The model has {len(prior.black_boxes)} black-box sites; expected one.")
    name, box = next(iter(prior.black_boxes.items()))
    if not isinstance(box, SimulatorBlackBox):
        raise DataError(f"Site {name!r} is a plain function and has no trajectory to replay.")
    names = [sensor.name for sensor in box.simulator.sensors]
    measured = [channel for channel in names if channel in rollouts.channel_names]
    trajectory = prior.execute_at(parameters)[name][..., [names.index(c) for c in measured]]
    return Replay(trajectory, inputs.select_channels(measured), tuple(measured))


def score(
    model: Callable[..., Any],
    rollouts: Rollouts,
    parameters: Mapping[str, Tensor],
    options: BindingOptions,
) -> dict[str, Tensor]:
    """Returns the paper's metrics of one parameter set, per rollout.

    Args:
        model: The Pyro model.
        rollouts: The recording.
        parameters: One value by latent site.
        options: Segments, initial states and precision.

    Returns:
        ``rmse`` and ``dtw``, ``(R,)`` each; see :mod:`npdr_ppl.metrics`.
    """
    batched = {name: torch.as_tensor(value)[None] for name, value in parameters.items()}
    replayed = replay(model, rollouts, batched, options)
    simulated = [series[0].double() for series in replayed.series()]
    measured = rollouts.series(replayed.channel_names)
    return {"rmse": metrics.rmse(simulated, measured), "dtw": metrics.dtw(simulated, measured)}


def nominal_parameters(model: Callable[..., Any], inputs: Inputs) -> dict[str, Tensor]:
    """Returns the simulator's nominal value of every latent site that carries a parameter's name.

    Raises:
        DataError: A latent site has no nominal value.
    """
    prior = Prior(model, (inputs,))
    nominal: dict[str, Tensor] = {}
    for box in prior.black_boxes.values():
        if isinstance(box, SimulatorBlackBox):
            nominal |= box.simulator.nominal()
            for effect in box.simulator.effects:
                values = effect.own_parameters({})
                nominal |= dict(zip(effect.parameter_names, values.values(), strict=True))
    missing = [site.name for site in prior.sites if site.name not in nominal]
    if missing:
        raise DataError(f"The simulator has no nominal value for {', '.join(missing)}.")
    return {site.name: nominal[site.name].expand(site.shape) for site in prior.sites}


def residual_noise(
    model: Callable[..., Any],
    rollouts: Rollouts,
    options: BindingOptions,
    *,
    num_draws: int = 500,
    seed: int = 0,
) -> dict[str, float]:
    """Returns a noise scale per channel at which the model can explain the recording.

    A simulator that lacks an effect never reproduces a recording exactly; without noise of the
    size of what is left, the recording is unlike every simulation and a likelihood-free posterior
    is extrapolation. The scale is the root-mean-square residual of the prior draw that comes
    nearest, an upper bound on what remains at the best parameters.

    Args:
        model: The Pyro model, without noise.
        rollouts: The recording to be fitted; never the held-out one.
        options: Segments, initial states and precision.
        num_draws: Prior draws to try.
        seed: Seed of the draws.
    """
    options = replace(options, precision="float64")
    inputs = rollouts.inputs(options.segment_length, options.initial_state, dtype=options.dtype)
    prior = Prior(model, (inputs,))
    with seeded(seed, "residual noise"):
        draws = prior.to_parameters(prior.sample(num_draws))
    best: tuple[float, Tensor] | None = None
    names: tuple[str, ...] = ()
    chunk = 100
    for start in range(0, num_draws, chunk):
        part = {name: value[start : start + chunk] for name, value in draws.items()}
        replayed = replay(model, rollouts, part, options)
        names = replayed.channel_names
        observed = rollouts.observation(replayed.inputs, channels=names)
        mask = replayed.inputs.mask[..., None]
        square = ((replayed.trajectory - observed) * mask).square().sum(dim=(1, 2)) / mask.sum()
        scale = (observed * mask).abs().amax(dim=(0, 1)).clamp_min(torch.finfo(square.dtype).tiny)
        error = (square.sqrt() / scale).mean(-1).nan_to_num(torch.inf)
        index = int(error.argmin())
        if best is None or float(error[index]) < best[0]:
            best = float(error[index]), square[index].sqrt()
    if best is None or not bool(torch.isfinite(best[1]).all()):
        raise DataError("No prior draw could be simulated along the recording.")
    return {name: max(float(v), 1e-9) for name, v in zip(names, best[1], strict=True)}
