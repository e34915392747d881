"""How far a model at given parameters is from measured rollouts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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

__all__ = [
    "ClosestFit",
    "Replay",
    "closest_fit",
    "declares_noise",
    "nominal_parameters",
    "replay",
    "residual_noise",
    "score",
]


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


def declares_noise(model: Callable[..., Any], rollouts: Rollouts, options: BindingOptions) -> bool:
    """Returns whether a model gives its readings noise of its own."""
    inputs = rollouts.inputs(options.segment_length, options.initial_state, dtype=options.dtype)
    return any(box.noise is not None for box in Prior(model, (inputs,)).black_boxes.values())


def residual_noise(
    model: Callable[..., Any],
    rollouts: Rollouts,
    options: BindingOptions,
    *,
    iterations: int = 6,
    population: int = 200,
    seed: int = 0,
) -> dict[str, float]:
    """Returns a noise scale per channel at which the model can explain the recording.

    It is the ``scale`` of :func:`closest_fit`, which has the arguments and errors.
    """
    fitted = closest_fit(
        model, rollouts, options, iterations=iterations, population=population, seed=seed
    )
    return fitted.scale


@dataclass(frozen=True)
class ClosestFit:
    """How near a model can come to a recording.

    Attributes:
        scale: Root-mean-square residual by channel, in the channel's unit.
        parameters: The parameters that leave it, ``(1,) + site.shape`` by latent site.
    """

    scale: dict[str, float]
    parameters: dict[str, Tensor]


def closest_fit(
    model: Callable[..., Any],
    rollouts: Rollouts,
    options: BindingOptions,
    *,
    iterations: int = 6,
    population: int = 200,
    seed: int = 0,
) -> ClosestFit:
    """Searches for the parameters of least residual along a recording.

    A simulator that lacks an effect never reproduces a recording exactly; without noise of the
    size of what is left, the recording is unlike every simulation and a likelihood-free posterior
    is extrapolation. The scale is the root-mean-square residual of the best parameters that a
    short cross-entropy search (Rubinstein 1999) over the prior's reference coordinates finds.

    Args:
        model: The Pyro model.
        rollouts: The recording to be fitted; never the held-out one.
        options: Segments, initial states and precision.
        iterations: Iterations of the search.
        population: Parameter sets of each iteration.
        seed: Seed of the search.

    Raises:
        DataError: No parameters could be simulated along the recording.
    """
    inputs = rollouts.inputs(options.segment_length, options.initial_state, dtype=options.dtype)
    prior = Prior(model, (inputs,))
    centre = torch.zeros(prior.num_parameters, dtype=torch.float64)
    spread = torch.ones_like(centre)
    best_error, best, best_z = float("inf"), torch.empty(0), centre
    names: tuple[str, ...] = ()
    for iteration in range(iterations):
        with seeded(seed, "residual noise", iteration):
            z = prior.sample(population) if iteration == 0 else torch.randn(
                population, prior.num_parameters, dtype=torch.float64
            ) * spread + centre  # fmt: skip
        replayed = replay(model, rollouts, prior.to_parameters(z), options)
        names = replayed.channel_names
        residual, error = _residuals(replayed, rollouts)
        elite = error.argsort()[: max(2, population // 10)]
        centre, spread = z[elite].mean(0), z[elite].std(0)
        if float(error[elite[0]]) < best_error:
            best_error, best, best_z = float(error[elite[0]]), residual[elite[0]], z[elite[0]]
    if not torch.isfinite(torch.tensor(best_error)):
        raise DataError("No parameters of the prior could be simulated along the recording.")
    scale = {name: max(float(v), 1e-9) for name, v in zip(names, best, strict=True)}
    return ClosestFit(scale, prior.to_parameters(best_z[None]))


def _residuals(replayed: Replay, rollouts: Rollouts) -> tuple[Tensor, Tensor]:
    """Returns the residuals' RMS per channel, ``(n, C)``, and their mean in units of the range."""
    observed = rollouts.observation(replayed.inputs, channels=replayed.channel_names)
    mask = replayed.inputs.mask[..., None]
    square = ((replayed.trajectory - observed) * mask).square().sum(dim=(1, 2)) / mask.sum()
    scale = (observed * mask).abs().amax(dim=(0, 1)).clamp_min(torch.finfo(square.dtype).tiny)
    return square.sqrt(), (square.sqrt() / scale).mean(-1).nan_to_num(torch.inf)
