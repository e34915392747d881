"""Remedies for faults of a recording: changes that can be tried and, if they explain it, applied.

Each remedy is a callable object that makes rollouts of rollouts, so that held-out rollouts can be
changed in the same way.
"""

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.settings import REPAIR
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.sampling import Sampling, common, placed, spans_without_gaps
from npdr_ppl.rollouts.simulator_checks import OTHER_UNITS

__all__ = ["Remedy", "Shift", "remedies", "without_one"]

SIGN_WINDOW = 4
"""Steps on each side of a zero crossing over which an absolute value falls and rises."""


@dataclass(frozen=True)
class Remedy:
    """A change of a recording that cures a fault.

    Attributes:
        sentence: What the fault looks like.
        apply: Changes rollouts.
    """

    sentence: str
    apply: Callable[[Rollouts], Rollouts]


def remedies(
    sensors: Sequence[Channel],
    rollouts: Rollouts,
    suspects: Collection[str] | None = None,
    *,
    singly: bool = True,
) -> Iterator[Remedy]:
    """Yields the remedies that can be tried on a recording.

    Args:
        sensors: The channels of the model that were measured.
        rollouts: The recording.
        suspects: Names of those that may have a fault; all if ``None``.
        singly: Whether single channels may have a fault, besides the whole recording.
    """
    measured = {sensor.name for sensor in sensors}
    suspects = measured if suspects is None else suspects
    units = {s.name: s.unit.removesuffix("/s") for s in sensors if s.name in suspects}
    pairs = [[s.rate_of, s.name] for s in sensors if s.name in units and s.rate_of in units]
    for group in ([[name] for name in units] + pairs) if singly else []:
        text = f"The sign of {' and '.join(group)} looks inverted; changed."
        yield Remedy(text, _Scaled(group, -1.0))
    for si, (other, factor) in OTHER_UNITS.items():
        chosen = [name for name, unit in units.items() if unit == si]
        single = [[name] for name in chosen if singly]
        together = [chosen] if len(chosen) > 1 or (chosen and not singly) else []
        for group in [*single, *together]:
            looks = "look" if len(group) > 1 else "looks"
            names = " and ".join(group)
            text = f"{names} {looks} recorded in {other}, not in SI units; converted."
            yield Remedy(text, _Scaled(group, 1.0 / factor))
    for k, name in enumerate(rollouts.action_names):
        if any(actions[:, k].any() for actions in rollouts.actions):
            text = f"The sign of {name} looks inverted; changed."
            yield Remedy(text, _ScaledAction(name, -1.0))
    shifts = [steps for steps in REPAIR.shifts if 4 * steps < min(rollouts.lengths)]
    long = _beyond_delays(rollouts)
    # Shifted commands that never change would only leave out the ends of the recording.
    if any(np.ptp(actions, axis=0).any() for actions in rollouts.actions if len(actions)):
        for steps in (*shifts, *(-steps for steps in long)):
            yield Shift(None, steps).remedy
    for sensor in (sensor for sensor in sensors if singly and sensor.name in suspects):
        column = rollouts.channel_names.index(sensor.name)
        values = np.concatenate(rollouts.measurements(column))
        if len(values) and values.min() >= 0.0 and values.max() > 0.0:
            text = f"{sensor.name} looks recorded without its sign, which was restored."
            rates = [other.name for other in sensors if other.rate_of == sensor.name]
            position = sensor.rate_of if sensor.rate_of in measured else None
            yield Remedy(text, _Signed(sensor.name, position, rates[0] if rates else None))
        limits = _plateaus(rollouts, column)
        if limits:
            text = f"{sensor.name} looks clipped; measurements at its limit are left out."
            yield Remedy(text, _WithoutLimits(sensor.name, limits))
        if len(sensors) > 1:
            for steps in (*(-steps for steps in shifts[2:]), *long):
                yield Shift(sensor.name, steps).remedy


def without_one(sensors: Sequence[Channel]) -> Iterator[Remedy]:
    """Yields remedies that leave out one channel each, if there are several.

    Args:
        sensors: The channels of the model that were measured.
    """
    for sensor in sensors if len(sensors) > 1 else ():
        text = f"{sensor.name} does not fit the other channels; it is not used."
        yield Remedy(text, _Without(sensor.name))


def _beyond_delays(rollouts: Rollouts) -> list[int]:
    """Returns shifts in steps that last longer than any device takes to answer a command."""
    longest = REPAIR.longest_delay / rollouts.time_step
    steps = {*REPAIR.shifts, *(round(times * longest) for times in REPAIR.long_shifts)}
    return sorted(n for n in steps if longest < n and 4 * n < min(rollouts.lengths))


@dataclass(frozen=True)
class _Scaled:
    """Multiplies channels by a factor."""

    channels: Sequence[str]
    factor: float

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        names = rollouts.channel_names
        factors = np.where([name in self.channels for name in names], self.factor, 1.0)
        return _changed(rollouts, lambda values: values * factors)


@dataclass(frozen=True)
class _ScaledAction:
    """Multiplies an action by a factor."""

    name: str
    factor: float

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        factors = np.where([n == self.name for n in rollouts.action_names], self.factor, 1.0)
        return replace(rollouts, actions=tuple(values * factors for values in rollouts.actions))


@dataclass(frozen=True)
class Shift:
    """Moves a channel, or all commands, some steps earlier, or later if negative.

    Attributes:
        channel: Name of the channel; ``None`` for the commands.
        steps: Number of steps, which need not be whole. Commands that are held for a step are
            averaged over the new steps.
    """

    channel: str | None
    steps: float

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        """Returns rollouts that are shifted."""
        if self.channel is None:
            return self._of_commands(rollouts)
        column = rollouts.channel_names.index(self.channel)
        readings, samplings = [], []
        for index, time in enumerate(rollouts.time):
            known, filled = rollouts.sampling(index), np.array(rollouts.readings[index])
            values, lateness = np.array(known.values), np.array(known.lateness)
            is_read, taken = np.array(known.is_read), known.is_read[:, column]
            if taken.any():
                rows = np.arange(len(time), dtype=np.float64)
                at = rows[taken] + lateness[taken, column] - self.steps
                measured = values[taken, column]
                found = placed(at, measured, len(rows))
                lateness[:, column], is_read[:, column] = found.lateness, found.is_read
                filled[:, column] = np.interp(rows, at, measured)
                values[:, column] = np.where(found.is_read, found.values, filled[:, column])
            readings.append(filled)
            samplings.append(Sampling(values, lateness, is_read))
        return _with_measurements(rollouts, column, readings, samplings)

    def _of_commands(self, rollouts: Rollouts) -> Rollouts:
        """Returns rollouts with shifted commands; where these are not known, it is not usable."""
        whole = math.floor(self.steps)
        part = self.steps - whole
        first, cut = max(0, -whole), max(0, math.ceil(self.steps))
        known = [((first, length - cut),) for length in rollouts.lengths]
        return replace(
            rollouts,
            actions=tuple(
                (1.0 - part) * _shifted(actions, whole) + part * _shifted(actions, whole + 1)
                for actions in rollouts.actions
            ),
            stretches=tuple(map(common, rollouts.spans, known)),
        )

    @property
    def remedy(self) -> Remedy:
        """The remedy, with its sentence."""
        name = f"{self.channel} looks"
        if self.channel is None:
            name = "The time stamps of the commands look"
        when = "late" if self.steps > 0 else "early"
        return Remedy(f"{name} about {abs(self.steps):.4g} steps too {when}; shifted.", self)

    def by(self, steps: float) -> Remedy:
        """Returns the remedy that moves some steps more."""
        return Shift(self.channel, self.steps + steps).remedy


@dataclass(frozen=True)
class _Signed:
    """Gives a channel of absolute values its sign.

    Attributes:
        name: The channel.
        position: The channel whose rate it is, if that was recorded.
        rate: Its own rate, if that was recorded.
    """

    name: str
    position: str | None
    rate: str | None

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        names = rollouts.channel_names
        column = names.index(self.name)

        def change(values: Array) -> Array:
            result = values.copy()
            size = values[:, column]
            evidence = None
            if self.position is not None:
                evidence = np.gradient(values[:, names.index(self.position)])
            elif self.rate is not None:
                evidence = np.gradient(size) * values[:, names.index(self.rate)]
            result[:, column] = _with_signs(size, evidence)
            return result

        return _changed(rollouts, change)


@dataclass(frozen=True)
class _WithoutLimits:
    """Leaves out a channel's measurements at the limits of its range."""

    name: str
    limits: Sequence[float]

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        column = rollouts.channel_names.index(self.name)
        readings, samplings = [], []
        for index, values in enumerate(rollouts.readings):
            known = rollouts.sampling(index)
            is_read = known.is_read.copy()
            is_read[np.isin(known.values[:, column], self.limits), column] = False
            kept = is_read[:, column]
            filled, rows = values.copy(), np.arange(len(values))
            if kept.any():
                filled[~kept, column] = np.interp(rows[~kept], rows[kept], values[kept, column])
            taken = np.where(is_read, known.values, filled)
            readings.append(filled)
            samplings.append(Sampling(taken, np.where(is_read, known.lateness, 0.0), is_read))
        return _with_measurements(rollouts, column, readings, samplings)


@dataclass(frozen=True)
class _Without:
    """Leaves out a channel."""

    name: str

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        return rollouts.select([name for name in rollouts.channel_names if name != self.name])


def _changed(rollouts: Rollouts, change: Callable[[Array], Array]) -> Rollouts:
    """Returns rollouts with readings that a function has changed, ``(T + 1, C)`` each."""
    return replace(
        rollouts,
        readings=tuple(map(change, rollouts.readings)),
        samplings=tuple(
            Sampling(change(s.values), s.lateness.copy(), s.is_read.copy())
            for s in rollouts.samplings
        ),
    )


def _shifted(values: NDArray[Any], steps: int) -> NDArray[Any]:
    """Returns values some rows earlier, or later if negative; the ends are repeated."""
    size = abs(steps)
    if size == 0:
        return values
    if steps > 0:
        return np.concatenate((values[size:], np.repeat(values[-1:], size, 0)))
    return np.concatenate((np.repeat(values[:1], size, 0), values[:-size]))


def _with_signs(size: Array, evidence: Array | None) -> Array:
    """Returns absolute values ``(N,)`` with signs that change only where they turn near zero.

    Args:
        size: The absolute values.
        evidence: A curve that has the sign on average; ``None`` if there is none, and the sign
            alternates.
    """
    reach = SIGN_WINDOW
    turns = [0]
    for k in range(reach, len(size) - reach):
        falls, rises = size[k - reach] - size[k], size[k + reach] - size[k]
        is_least = size[k] <= size[k - reach : k + reach + 1].min()
        if is_least and size[k] < 0.5 * min(falls, rises) and k - turns[-1] >= reach:
            # The sign changes on the side on which the value is already rising.
            turns.append(k + int(size[k + 1] > size[k - 1]))
    result = size.copy()
    for number, (begin, end) in enumerate(itertools.pairwise((*turns, len(size)))):
        sign = (-1.0) ** number
        if evidence is not None:
            sign = float(np.sign(size[begin:end] @ evidence[begin:end])) or 1.0
        result[begin:end] *= sign
    return result


def _plateaus(rollouts: Rollouts, column: int) -> list[float]:
    """Returns the ends of a channel's range at which it stays for several measurements."""
    values = np.concatenate(rollouts.measurements(column))
    ends = [float(values.min()), float(values.max())]
    changes = np.diff(values)
    limits = []
    for end in ends:
        at_end = values == end
        stays = at_end[1:] & at_end[:-1]
        # Other values are hardly ever repeated, unless the encoder is coarse.
        usual = (changes[~at_end[1:]] == 0).mean() if (~at_end[1:]).any() else 1.0
        if stays.sum() >= REPAIR.fewest_clipped and stays.sum() > 2 * usual * at_end.sum():
            limits.append(end)
    return limits if ends[0] < ends[1] else []


def _with_measurements(
    rollouts: Rollouts, column: int, readings: Sequence[np.ndarray], samplings: Sequence[Sampling]
) -> Rollouts:
    """Returns rollouts with other measurements; gaps of the changed column split them."""
    spans = [
        common(known, spans_without_gaps(sampling.is_read[:, [column]]))
        for known, sampling in zip(rollouts.spans, samplings, strict=True)
    ]
    return replace(
        rollouts,
        readings=tuple(readings),
        samplings=tuple(samplings),
        stretches=tuple(spans),
    )
