"""The distance of a model with given parameters from measured rollouts."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts, stitch

__all__ = [
    "Replay",
    "nominal_parameters",
    "replay",
    "score",
]


@dataclass(frozen=True)
class Replay:
    """Simulation of recorded actions, without noise.

    Attributes:
        trajectory: Readings after each step, ``(n, S, K, C)``.
        inputs: The segments.
        channel_names: Names of the C measured channels.
        units: Their units, from the recording or, if it has none, from the simulator.
    """

    trajectory: Tensor
    inputs: Inputs
    channel_names: tuple[str, ...]
    units: tuple[str, ...]

    def series(self) -> list[Tensor]:
        """Returns the states before each step, one ``(n, T, C)`` per rollout."""
        return stitch(self.trajectory, self.inputs, self.channel_names)


def replay(
    model: Model,
    rollouts: Rollouts,
    parameters: Mapping[str, Tensor],
    options: DataOptions,
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
    inputs = options.with_certain_start().inputs(rollouts)
    prior = Prior(with_noise(model, None), (inputs,))
    if len(prior.black_boxes) != 1:
        raise DataError(f"The model has {len(prior.black_boxes)} black-box sites; expected one.")
    name, box = next(iter(prior.black_boxes.items()))
    if not isinstance(box, SimulatorBlackBox):
        raise DataError(f"Site {name!r} is a plain function and has no trajectory to replay.")
    names = [sensor.name for sensor in box.simulator.sensors]
    measured = [channel for channel in names if channel in rollouts.measured_names]
    trajectory = prior.execute_at(parameters)[name][..., [names.index(c) for c in measured]]
    recorded = dict(zip(rollouts.channel_names, rollouts.channel_units, strict=True))
    units = tuple(
        recorded[sensor.name] or sensor.unit
        for sensor in box.simulator.sensors
        if sensor.name in recorded
    )
    return Replay(trajectory, inputs.select_channels(measured), tuple(measured), units)


def score(
    model: Model,
    rollouts: Rollouts,
    parameters: Mapping[str, Tensor],
    options: DataOptions,
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


def nominal_parameters(model: Model, inputs: Inputs) -> dict[str, Tensor]:
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
