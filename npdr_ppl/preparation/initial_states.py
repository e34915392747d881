"""Estimates of the segments' initial states, with the help of a fitted model.

A smoother does not know the commands. Where a command changes, rates change abruptly, and a
polynomial through the measurements is biased in a way that looks like a delay. The difference
between measurements and a model's prediction has no such abrupt changes. It is therefore this
difference that is smoothed: measurements before a segment's start minus those that the model
predicts from an earlier state. Measurements after the start are not used, because the segment
itself is fitted to them.
"""

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.language.channels import Follower, Spin
from npdr_ppl.language.effects import SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.settings import INITIAL_STATES
from npdr_ppl.preparation.solving import is_invertible
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.segments import cut
from npdr_ppl.rollouts.states import estimate_departures

__all__ = [
    "InitialStates",
    "error_draws",
    "error_factors",
    "estimate_starts",
    "uncertain_components",
    "with_spins",
]


@dataclass(frozen=True)
class InitialStates:
    """Initial states of S segments, ``(S, channels)`` each.

    Attributes:
        values: Measured channels without their noise, in their units.
        rates: Their time derivatives, in units per second.
        value_errors: Standard deviations of the values' errors.
        rate_errors: Standard deviations of the rates' errors.
    """

    values: Tensor
    rates: Tensor
    value_errors: Tensor
    rate_errors: Tensor

    @classmethod
    def of(cls, inputs: Inputs) -> "InitialStates | None":
        """Returns the initial states of inputs; ``None`` if they are certain."""
        found = (
            inputs.initial_values,
            inputs.initial_rates,
            inputs.initial_value_errors,
            inputs.initial_rate_errors,
        )
        return None if any(part is None for part in found) else cls(*found)  # pyright: ignore

    def scaled(self, inputs: Inputs, factors: Tensor) -> "InitialStates":
        """Returns the same with larger or smaller errors.

        Args:
            inputs: Inputs with these initial states.
            factors: Factor of each uncertain component; see :func:`uncertain_components`.
        """
        errors = {"initial_values": self.value_errors, "initial_rates": self.rate_errors}
        errors = {name: error.clone() for name, error in errors.items()}
        for (name, column, _), factor in zip(uncertain_components(inputs), factors, strict=True):
            errors[name][:, column] *= factor
        return InitialStates(
            self.values, self.rates, errors["initial_values"], errors["initial_rates"]
        )

    def segments(self, index: Tensor) -> "InitialStates":
        """Returns the initial states of some of the segments."""
        return InitialStates(*(getattr(self, field.name)[index] for field in fields(self)))

    def replaced(self, rows: Tensor, new: "InitialStates", where: Tensor) -> "InitialStates":
        """Returns the same with some values replaced.

        Args:
            rows: Indices of the n segments.
            new: Their new values, ``(n, channels)`` each.
            where: Mask of the values that are replaced, ``(n, channels)``.
        """
        changed = {}
        for field in fields(self):
            table = getattr(self, field.name).clone()
            table[rows] = torch.where(where, getattr(new, field.name).to(table), table[rows])
            changed[field.name] = table
        return InitialStates(**changed)

    def put_into(self, inputs: Inputs) -> Inputs:
        """Returns inputs with these initial states."""
        return replace(
            inputs,
            initial_values=self.values,
            initial_rates=self.rates,
            initial_value_errors=self.value_errors,
            initial_rate_errors=self.rate_errors,
        )


_OF_RATES = (
    ((1, -1.0), (0, 1.0), (3, 1.0), (2, -1.0)),
    ((2, -1.0), (3, -1.0), (0, 1.0), (1, 1.0)),
    ((3, -1.0), (2, 1.0), (1, -1.0), (0, 1.0)),
)
"""Half a spin is the imaginary part of q* q̇. For each axis: the part of q = (w, x, y, z) by which
each part of q̇ is multiplied, and its sign."""


def with_spins(states: InitialStates, simulator: Simulator, rollouts: Rollouts) -> InitialStates:
    """Returns initial states whose spins follow from the orientations, if they were not measured.

    Args:
        states: The initial states.
        simulator: The simulator.
        rollouts: The recording.
    """
    names, measured = rollouts.channel_names, rollouts.measured_names
    spins = [
        f
        for f in simulator.followers
        if isinstance(f, Spin) and {f.name, *f.leaders} <= set(names) and f.name not in measured
    ]
    if not spins:
        return states
    values, errors = states.values.clone(), states.value_errors.clone()
    rate_errors = states.rate_errors.clone()
    for spin in spins:
        columns, own = [names.index(leader) for leader in spin.leaders], names.index(spin.name)
        quaternion = values[:, columns]
        quaternion = quaternion / quaternion.square().sum(-1, keepdim=True)  # q̇ has its norm
        signed = torch.stack([s * quaternion[:, k] for k, s in _OF_RATES[spin.axis]], dim=-1)
        values[:, own] = 2.0 * (signed * states.rates[:, columns]).sum(-1)
        errors[:, own] = 2.0 * (signed * rate_errors[:, columns]).square().sum(-1).sqrt()
        rate_errors[:, own] = 0.0
    return replace(states, values=values, value_errors=errors, rate_errors=rate_errors)


def uncertain_components(inputs: Inputs) -> list[tuple[str, int, Tensor]]:
    """Returns field, channel and standard deviations ``(S,)`` of each uncertain component."""
    found = []
    for name, errors in (
        ("initial_values", inputs.initial_value_errors),
        ("initial_rates", inputs.initial_rate_errors),
    ):
        if errors is not None:
            for column in range(errors.shape[-1]):
                error = errors[..., column].double()
                if bool((error > 0).any()):
                    found.append((name, column, error))
    return found


def estimate_starts(
    box: SimulatorBlackBox, inputs: Inputs, rollouts: Rollouts
) -> InitialStates | None:
    """Estimates initial states from the difference between measurements and a model.

    The first state of a usable stretch is kept, because no measurement precedes it, and so are
    states at which the model cannot be simulated.

    Args:
        box: The simulator and its parameters, those of a fit.
        inputs: The segments, as cut from the rollouts and smoothed.
        rollouts: The recording.

    Returns:
        The initial states; ``None`` if those of the inputs are certain.
    """
    known = InitialStates.of(inputs)
    if known is None:
        return None
    length = inputs.num_steps
    wanted = list(zip(inputs.rollout.tolist(), inputs.start.tolist(), strict=True))
    layout = [
        (rollout, max(_first_usable(rollouts, rollout, start), start - length), start + 1)
        for rollout, start in wanted  # one more step, for the rates
    ]
    around = cut(
        rollouts,
        layout,
        initial_state="estimated",
        history=inputs.past_actions.shape[-2],
        dtype=inputs.actions.dtype,
    )
    around = replace(around, began_in_operation=inputs.began_in_operation)
    places = inputs.start - around.start
    simulated = _simulated(box.simulator, box.parameters, around)
    predicted = _predicted(box.simulator, simulated, around)
    rates = _predicted_rates(box, around, simulated, predicted, places)
    row = torch.arange(len(places))
    reported = {sensor.name for sensor in box.simulator.sensors}
    is_reported = torch.tensor([name in reported for name in around.channel_names])
    values, found = predicted[row, places], known
    for index, readings in enumerate(rollouts.readings):
        own = torch.nonzero((around.rollout == index) & (places > 0))[:, 0]
        departure = estimate_departures(
            readings,
            [predicted[i, : places[i] + 1].numpy() for i in own],
            around.start[own].numpy(),
            inputs.start[own].numpy(),
            rollouts.time_step,
            rollouts.samplings[index].is_read if rollouts.samplings else None,
        )
        shift, rate, error, rate_error = (
            torch.from_numpy(part).to(values)
            for part in (
                departure.values,
                departure.rates,
                departure.value_errors,
                departure.rate_errors,
            )
        )
        for this, leader, slope in _followers(box.simulator, rollouts, values[own]):
            shift[:, this], rate[:, this] = slope * shift[:, leader], slope * rate[:, leader]
            error[:, this] = rate_error[:, this] = 0.0
        new = InitialStates(values[own] + shift, rates[own] + rate, error, rate_error)
        new = with_spins(new, box.simulator, rollouts)
        is_better = is_reported & (new.values + new.rates).isfinite()
        found = found.replaced(own, new, is_better)
    return found


def _followers(
    simulator: Simulator, rollouts: Rollouts, values: Tensor
) -> Iterator[tuple[int, int, Tensor]]:
    """Yields the positions that were not measured because they follow from others.

    Of each its column, that of the position which it follows, and the slope there, ``(n,)``. The
    simulated difference from the exact coupling is kept, because a constraint is not rigid.

    Args:
        simulator: The simulator.
        rollouts: The recording.
        values: Values of the channels, ``(n, channels)``.
    """
    names = rollouts.channel_names
    for follower in (f for f in simulator.followers if isinstance(f, Follower)):
        is_there = follower.name in names and follower.leader in rollouts.measured_names
        if is_there and follower.name not in rollouts.measured_names:
            leader = names.index(follower.leader)
            slope = np.polynomial.Polynomial(follower.coefficients).deriv()
            yield (
                names.index(follower.name),
                leader,
                torch.as_tensor(slope(values[:, leader].numpy())),
            )


def _first_usable(rollouts: Rollouts, rollout: int, step: int) -> int:
    """Returns the first step of the usable stretch of a rollout that contains a step."""
    return next(first for first, end in rollouts.spans[rollout] if first <= step < end)


def _simulated(simulator: Simulator, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
    """Returns all of a simulator's readings after each step, ``(S, K, sensors)``."""
    readings = simulator.simulate(parameters, inputs)
    return readings.reshape(inputs.num_segments, inputs.num_steps, len(simulator.sensors))


def _predicted(simulator: Simulator, simulated: Tensor, inputs: Inputs) -> Tensor:
    """Returns the recorded channels from each segment's start on, ``(S, K + 1, channels)``.

    Channels that the simulator does not have are zero.
    """
    names = [sensor.name for sensor in simulator.sensors]
    result = torch.zeros(inputs.num_segments, inputs.num_steps + 1, len(inputs.channel_names)).to(
        simulated
    )
    for column, name in enumerate(inputs.channel_names):
        if name in names:
            result[:, 0, column] = inputs.initial_values[:, column]
            result[:, 1:, column] = simulated[..., names.index(name)]
    return result


def _predicted_rates(
    box: SimulatorBlackBox, inputs: Inputs, simulated: Tensor, predicted: Tensor, places: Tensor
) -> Tensor:
    """Returns the rates of the recorded channels at one step of each segment, ``(S, channels)``.

    It is the simulated velocity, recorded or not, if there is one and nothing else changes the
    position; otherwise the central difference of the simulated measurements, which is wrong where
    a command jumps.
    """
    simulator = box.simulator
    row = torch.arange(len(places))
    last = inputs.mask.sum(-1)
    after, before = (places + 1).minimum(last), (places - 1).clamp_min(0)
    rates = (predicted[row, after] - predicted[row, before]) / (
        (after - before)[:, None] * inputs.time_step
    )
    effects = [effect for effect in simulator.effects if isinstance(effect, SensorEffect)]
    ports = [simulator.port(effect.port) for effect in effects]
    if any(port.kind == "clock" for port in ports):
        return rates
    changed = {name for port in ports for name in port.channels}
    reported = [sensor.name for sensor in simulator.sensors]
    columns = {name: i for i, name in enumerate(inputs.channel_names)}
    known = {
        columns[state.rate_of]: reported.index(state.name)
        for state in simulator.states
        if state.rate_of in columns and state.rate_of not in changed and state.name in reported
    }
    if known and effects:
        plain = copy.copy(simulator)
        plain.effects = tuple(e for e in simulator.effects if not isinstance(e, SensorEffect))
        own = {name for effect in effects for name in effect.parameter_names}
        rest = {name: value for name, value in box.parameters.items() if name not in own}
        simulated = _simulated(plain, rest, inputs)
    # The first state is not simulated, and not needed.
    there = simulated[row, (places - 1).clamp_min(0)]
    for column, sensor in known.items():
        rates[:, column] = there[:, sensor]
    return rates


def error_factors(residual: Tensor, by_starts: Tensor) -> Tensor:
    """Returns the factors by which the initial states' errors are larger than assumed, ``(m,)``.

    They are the most likely standard deviations of the offsets at the fitted parameters
    (expectation maximisation; Dempster, Laird & Rubin 1977). Segments in which the simulation
    diverges are left out.

    Args:
        residual: Whitened residuals with all offsets at zero, ``(S, N)``.
        by_starts: Their derivatives by the offsets, ``(S, N, m)``.
    """
    information, score = _normal_equations(residual, by_starts)
    eye = torch.eye(by_starts.shape[-1], dtype=torch.float64)
    factors = torch.ones(by_starts.shape[-1], dtype=torch.float64)
    # Checked at the largest factors, at which the matrix is closest to singular.
    is_known = is_invertible(eye / INITIAL_STATES.factor_limits[1] ** 2 + information)
    if not bool(is_known.any()):
        return factors
    information, score = information[is_known], score[is_known]
    for _ in range(INITIAL_STATES.iterations):
        mean, covariance = _posterior(information, score, factors)
        square = (mean.square() + covariance.diagonal(dim1=-2, dim2=-1)).mean(0)
        factors = (factors * square.sqrt()).clamp(*INITIAL_STATES.factor_limits)
    return factors


def error_draws(residual: Tensor, by_starts: Tensor, factors: Tensor) -> Tensor:
    """Returns a draw of the offsets that lead from the estimates to the true initial states.

    It is a draw of their posterior, ``(S, m)``, from torch's global stream. In segments in which
    the simulation diverges, it is one of their prior.

    Args:
        residual: Whitened residuals with all offsets at zero, ``(S, N)``.
        by_starts: Their derivatives by the offsets, ``(S, N, m)``.
        factors: Standard deviations of the offsets, see :func:`error_factors`, ``(m,)``.
    """
    is_finite = residual.isfinite().all(-1) & by_starts.isfinite().all(-1).all(-1)
    information, score = _normal_equations(residual[is_finite], by_starts[is_finite])
    eye = torch.eye(len(factors), dtype=torch.float64)
    is_known = is_invertible(eye / factors.square() + information)
    index = is_finite.nonzero()[is_known, 0]
    mean, covariance = _posterior(information[is_known], score[is_known], factors)
    drawn = torch.randn(len(residual), len(factors), dtype=torch.float64)
    root = torch.linalg.cholesky(covariance)
    drawn[index] = mean + (root @ drawn[index][..., None])[..., 0]
    return factors * drawn


def _normal_equations(residual: Tensor, by_starts: Tensor) -> tuple[Tensor, Tensor]:
    """Returns information ``(S, m, m)`` and score ``(S, m)`` of the offsets."""
    return by_starts.mT @ by_starts, -(by_starts.mT @ residual[..., None])[..., 0]


def _posterior(information: Tensor, score: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean ``(S, m)`` and covariance ``(S, m, m)`` of the offsets over their factors."""
    eye = torch.eye(len(factors), dtype=torch.float64)
    covariance = torch.linalg.inv(eye + factors[:, None] * information * factors)
    return (covariance @ (factors * score)[..., None])[..., 0], covariance
