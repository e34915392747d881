"""Finds faults of a recording that are visible without a model, and leaves out what they touch.

A lost sample, a spike, a frozen channel or a broken last row costs the measurements that it
touches, or the step across it; the rest of the recording is used. What is left out is said in
``Recording.notes``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.fault_settings import FAULTS
from npdr_ppl.rollouts.sampling import Sampling, common, spans_without_gaps, split
from npdr_ppl.rollouts.time_faults import (
    is_last_row_wrong,
    lost_steps,
    near,
    swapped_rows,
    time_jumps,
)

__all__ = ["without_faults"]


def without_faults(rollouts: Rollouts, channels: Sequence[Channel]) -> Rollouts:
    """Returns rollouts in which faults that are visible without a model are left out.

    Args:
        rollouts: The recording.
        channels: The channels that are used; all must be recorded.

    Raises:
        DataError: Nothing usable is left.
    """
    rollouts, channels = _without_dead_channels(rollouts, channels)
    columns = {channel.name: rollouts.channel_names.index(channel.name) for channel in channels}
    partners = {
        columns[rate.name]: columns[rate.rate_of] for rate in channels if rate.rate_of in columns
    }
    limits = {column: _limits(rollouts, column) for column in columns.values()}

    def search(clipped: frozenset[int]) -> list[_Faults]:
        every = range(len(rollouts))
        return [
            _Faults(rollouts, k, [*columns.values()], partners, limits, clipped) for k in every
        ]

    found = search(frozenset())
    # Where one plateau is certainly wrong, the others at the same limit are, too.
    if clipped := frozenset[int]().union(*(part.clipped for part in found)):
        found = search(clipped)
    notes = [note for part in found for note in part.notes]
    if not notes:
        return rollouts
    return replace(
        rollouts,
        readings=tuple(
            np.where(part.sampling.is_read, readings, part.sampling.values)
            for part, readings in zip(found, rollouts.readings, strict=True)
        ),
        samplings=tuple(part.sampling for part in found),
        stretches=tuple(part.spans for part in found),
        notes=(*rollouts.notes, *notes),
    )


def _without_dead_channels(
    rollouts: Rollouts, channels: Sequence[Channel]
) -> tuple[Rollouts, Sequence[Channel]]:
    """Leaves out channels that never change, although their rate or their position does."""

    def values(name: str) -> list[Array]:
        column = rollouts.channel_names.index(name)
        return [v for v in rollouts.measurements(column) if len(v)]

    names = [channel.name for channel in channels]
    pairs = [(c.name, c.rate_of) for c in channels if c.rate_of in names]
    notes, dead = [], set()
    for pair in pairs:
        for name, other in (pair, pair[::-1]):
            if other is None or name is None:
                continue
            is_rate = pair[0] == name
            moving = _changes_speed if is_rate else _moves_clearly
            if _is_constant(values(name)) and any(map(moving, values(other))):
                dead.add(name)
                notes.append(f"{name} never changes, although {other} does; it is not used.")
    if not dead:
        return rollouts, channels
    left = rollouts.select([name for name in rollouts.channel_names if name not in dead])
    left = replace(left, notes=(*left.notes, *notes))
    return left, [channel for channel in channels if channel.name not in dead]


def _is_constant(stretches: Sequence[Array]) -> bool:
    """Returns whether a channel has the same value everywhere in each stretch."""
    return all(np.ptp(values) == 0.0 for values in stretches)


def _changes_speed(positions: Array) -> bool:
    """Returns whether a position moves at a speed that changes, so that its rate does, too."""
    return _moves_clearly(positions) and _moves_clearly(signal.detrend(positions))


def _moves_clearly(values: Array) -> bool:
    """Returns whether a channel changes by more than its noise, and not only by encoder steps."""
    if len(values) < FAULTS.least_steps:
        return False
    noise = np.sqrt(np.square(np.diff(values, n=2)).mean() / 6.0)
    num_levels = len(np.unique(values))
    return bool(np.ptp(values) > FAULTS.jump_size * noise and num_levels > FAULTS.least_steps)


class _Faults:
    """The faults of one rollout.

    Attributes:
        sampling: The measurements without those that are wrong.
        spans: The usable stretches.
        notes: What was left out, a sentence each.
        clipped: Columns of channels that are clipped.
    """

    def __init__(
        self,
        rollouts: Rollouts,
        index: int,
        columns: Sequence[int],
        position_of: Mapping[int, int],
        limits: Mapping[int, tuple[float, float]],
        clipped: frozenset[int],
    ) -> None:
        self.notes: list[str] = []
        self.clipped = set(clipped)
        self._position_of = position_of
        self._limits = limits
        self._rate_of = {position: rate for rate, position in position_of.items()}
        self._where = f"Rollout {index}"
        self._step = rollouts.time_step
        self._names = rollouts.channel_names
        sampling = rollouts.sampling(index)
        self._was_read, self._is_read = sampling.is_read, sampling.is_read.copy()
        self._values = np.array(rollouts.readings[index])
        lost: list[int] = []
        for first, end in rollouts.spans[index]:
            if end - first < FAULTS.least_steps:
                continue
            for column in columns:
                self._leave_out_spikes(first, end, column)
            # Rates first: a position is not frozen because a frozen rate says that it moves.
            for column in sorted(columns, key=lambda column: column in self._rate_of):
                self._leave_out_freezes(first, end, column)
            lost += self._lost_samples(first, end, columns)
        self.sampling, self.spans = sampling, rollouts.spans[index]
        if self.notes:
            values = np.where(self._is_read, sampling.values, self._filled())
            lateness = np.where(self._is_read, sampling.lateness, 0.0)
            self.sampling = Sampling(values, lateness, self._is_read)
            usable = spans_without_gaps(self._is_read[:, columns])
            self.spans = common(split(self.spans, lost), usable)

    def _filled(self) -> Array:
        """Returns the readings, interpolated where a measurement is left out."""
        rows = np.arange(len(self._values))
        filled = self._values.copy()
        for k in range(filled.shape[1]):
            kept, left_out = self._is_read[:, k], self._was_read[:, k] & ~self._is_read[:, k]
            if kept.any() and left_out.any():
                filled[left_out, k] = np.interp(rows[left_out], rows[kept], filled[kept, k])
        return filled

    def _time(self, row: int) -> str:
        return f"{row * self._step:.4g} s"

    def _leave_out_spikes(self, first: int, end: int, column: int) -> None:
        values = self._values[first : end + 1, column]
        rows = _spikes(values) + first
        if column in self._rate_of:
            rows = rows[self._contradict_rate(rows, column)]
        if not len(rows):
            return
        self._is_read[rows, column] = False
        self._values[rows, column] = np.interp(
            rows,
            np.delete(np.arange(first, end + 1), rows - first),
            np.delete(values, rows - first),
        )
        many = f"{len(rows)} measurements" if len(rows) > 1 else "one measurement"
        self.notes.append(
            f"{self._where}: {many} of {self._names[column]} left out as spikes, the first at "
            f"{self._time(int(rows[0]))}."
        )

    def _contradict_rate(self, rows: NDArray[np.int64], column: int) -> NDArray[np.bool_]:
        """Returns of which rows a position contradicts its rate, in both steps beside the row.

        At an impact a position has a kink, which can look like a spike, but its rate agrees in the
        step before or after it.
        """
        position, rate = self._values[:, column], self._values[:, self._rate_of[column]]
        size = position[rows] - 0.5 * (position[rows - 1] + position[rows + 1])

        def unexplained(row: NDArray[np.int64]) -> Array:
            moved = 0.5 * self._step * (rate[row] + rate[row + 1])
            return np.sign(size) * (position[row + 1] - position[row] - moved)

        both = np.minimum(unexplained(rows - 1), -unexplained(rows))
        return both > FAULTS.contradicted_share * np.abs(size)

    def _leave_out_freezes(self, first: int, end: int, column: int) -> None:
        rows = slice(first, end + 1)
        if column in self._rate_of:
            found = self._frozen_positions(rows, column, self._rate_of[column])
        elif column in self._position_of:
            found = self._frozen_rates(rows, column, self._position_of[column])
        else:
            return
        for begin, stop in self._without_limits(rows, column, found):
            # The first of the equal values is still right.
            self._is_read[first + begin + 1 : first + stop, column] = False
            self.notes.append(
                f"{self._where}: {self._names[column]} is frozen from "
                f"{self._time(first + begin)} to {self._time(first + stop)}; left out."
            )

    def _without_limits(
        self, rows: slice, column: int, found: Sequence[tuple[int, int]]
    ) -> list[tuple[int, int]]:
        """Leaves out plateaus at the ends of a channel's range, if one is certainly wrong.

        Returns:
            The other frozen stretches.
        """
        values, limits = self._values[rows, column], self._limits[column]
        others = [span for span in found if values[span[0]] not in limits]
        at_limit = np.isin(values, limits)
        if len(others) < len(found) or (column in self.clipped and at_limit.any()):
            self.clipped.add(column)
            self._is_read[rows, column] &= ~at_limit
            self.notes.append(
                f"{self._where}: {self._names[column]} looks clipped; {int(at_limit.sum())} "
                "measurements at its limit are left out."
            )
        return others

    def _frozen_positions(self, rows: slice, column: int, rate: int) -> list[tuple[int, int]]:
        """Returns stretches in which a position stays, but its rate says that it moves."""
        values = self._values[rows, column]
        rates = np.where(self._is_read[rows, rate], self._values[rows, rate], 0.0)
        moved = self._step * np.cumsum(rates)
        least, fastest = FAULTS.frozen_change * _usual_change(values), float(np.abs(rates).max())
        return [
            (begin, stop)
            for begin, stop in _constant(values)
            if np.abs(moved[begin:stop] - moved[begin]).max() > least
            # A device at rest moves by nothing but the bias of its rate.
            and np.sqrt(np.square(rates[begin:stop]).mean()) > FAULTS.frozen_share * fastest
        ]

    def _frozen_rates(self, rows: slice, column: int, position: int) -> list[tuple[int, int]]:
        """Returns stretches in which a rate stays, but its position says that it changes."""
        values, positions = self._values[rows, column], self._values[rows, position]
        noise = np.sqrt(np.square(np.diff(positions, n=2)).mean() / 6.0)
        least = FAULTS.frozen_change * _usual_change(values)

        def is_frozen(begin: int, stop: int) -> bool:
            half = (stop - begin) // 2
            time = self._step * (np.arange(half) - (half - 1) / 2.0)
            # A rate that rises and falls shows in the middle.
            firsts = begin, (begin + stop - half) // 2, stop - half
            slopes = [time @ positions[first : first + half] / (time @ time) for first in firsts]
            error = noise * np.sqrt(2.0 / (time @ time))
            return bool(np.ptp(slopes) > max(least, FAULTS.joint_departure * error))

        return [span for span in _constant(values) if is_frozen(*span)]

    def _pairs_in(self, columns: Sequence[int]) -> list[tuple[int, int]]:
        """Returns places of positions and of their rates among columns."""
        place = {column: k for k, column in enumerate(columns)}
        return [(place[position], place[rate]) for rate, position in self._position_of.items()]

    def _lost_samples(self, first: int, end: int, columns: Sequence[int]) -> list[int]:
        values = self._values[first : end + 1, columns]
        pairs = self._pairs_in(columns)
        swapped = swapped_rows(values, pairs, self._step)
        if swapped:
            for row in swapped:
                self._is_read[first + row : first + row + 2] = False
            self.notes.append(
                f"{self._where}: neighbouring samples look swapped (pairs: {len(swapped)}, "
                f"the first at {self._time(first + swapped[0])}); left out."
            )
        if is_last_row_wrong(values):
            self._is_read[end] = False
            self.notes.append(f"{self._where}: the last sample is wrong; left out.")
            values = values[:-1]
        found = set(lost_steps(values)) | set(time_jumps(values, pairs, self._step))
        found -= {row + shift for row in swapped for shift in range(-2, 4)}
        steps = [first + step for step in sorted(found)]
        if steps:
            gaps = [steps[0]] + [b for a, b in zip(steps, steps[1:], strict=False) if b > a + 1]
            self.notes.append(
                f"{self._where} seems to have lost or repeated samples "
                f"(number of gaps: {len(gaps)}, the "
                f"first at {self._time(steps[0])}); it is used in pieces."
            )
        return steps


def _spikes(values: Array) -> NDArray[np.int64]:
    """Returns the rows of single wrong measurements of a channel ``(N,)``.

    A spike leaves the course of the channel, and the next measurements return to that course. The
    spike is therefore off the course before it and off the course after it, and changing this one
    value makes the channel smooth.
    """
    departure = _departures(values)
    size = np.abs(departure)
    usual = np.maximum(np.median(size[2:-2]), near(size[:, None])[:, 0]) / 0.6745
    # A device at rest has departures of zero; its encoder still makes single steps.
    changes = np.abs(np.diff(values))
    floor = FAULTS.spike_change * np.median(changes[changes > 0]) if changes.any() else np.inf
    is_large = (size > FAULTS.jump_size * usual) & (size > floor)
    rows = []
    for row in np.flatnonzero(is_large & _leaves_and_returns(values, departure)):
        if size[row] < size[max(0, row - 2) : row + 3].max():
            continue
        mended = values.copy()
        mended[row] -= departure[row]
        around = slice(max(2, row - 1), min(len(values) - 2, row + 2))
        left = _departures(mended[around.start - 2 : around.stop + 2])[2:-2]
        # A step or a pulse of several measurements is not mended by changing one value.
        if np.abs(left).max() < max(FAULTS.mended_share * size[row], 4.0 * usual[row]):
            rows.append(int(row))
    if len(rows) > FAULTS.most_lost * len(values):
        return np.array([], dtype=np.int64)
    return np.array(rows, dtype=np.int64)


def _leaves_and_returns(values: Array, departure: Array) -> NDArray[np.bool_]:
    """Returns which of values ``(N,)`` leave a course that the next values return to.

    The courses before and after a row are the lines through the two measurements on that side.
    At a spike, both lines pass the row at nearly the same value, and the measurement departs from
    both by the size of the spike. At a kink, an impact or a step of a command, the measurement
    lies on one line, on both, or between them: the channel goes on from it.

    Args:
        values: A channel's measurements.
        departure: Their distances from the cubic through their neighbours, ``(N,)``.

    Returns:
        Whether each measurement leaves and returns, ``(N,)``. False at both ends, where there are
        not two measurements on each side.
    """
    before = 2.0 * values[1:-3] - values[:-4]
    after = 2.0 * values[3:-1] - values[4:]
    nearest = np.minimum(np.abs(values[2:-2] - before), np.abs(values[2:-2] - after))
    least = FAULTS.off_course_share * np.abs(departure[2:-2])
    result = np.zeros(len(values), dtype=bool)
    result[2:-2] = nearest > np.maximum(least, np.abs(after - before))
    return result


def _departures(values: Array) -> Array:
    """Returns the distance of values ``(N,)`` from a cubic through the two on each side.

    Zero at both ends, where there are not two.
    """
    result = np.zeros(len(values))
    cubic = (-values[:-4] + 4.0 * values[1:-3] + 4.0 * values[3:-1] - values[4:]) / 6.0
    result[2:-2] = values[2:-2] - cubic
    return result


def _limits(rollouts: Rollouts, column: int) -> tuple[float, float]:
    """Returns the ends of a channel's range. A channel hardly ever freezes exactly there."""
    values = [readings[:, column] for readings in rollouts.usable_readings]
    return min(float(v.min()) for v in values), max(float(v.max()) for v in values)


def _constant(values: Array) -> list[tuple[int, int]]:
    """Returns first row and end of the long stretches in which a channel keeps its value."""
    edges = np.flatnonzero(np.diff(values) != 0) + 1
    bounds = np.concatenate(([0], edges, [len(values)])).tolist()
    spans = zip(bounds[:-1], bounds[1:], strict=True)
    return [span for span in spans if span[1] - span[0] >= FAULTS.least_freeze]


def _usual_change(values: Array) -> float:
    """Returns the usual change of a channel from one measurement to the next, if it changes."""
    changes = np.abs(np.diff(values))
    return float(np.median(changes[changes > 0])) if changes.any() else np.inf
