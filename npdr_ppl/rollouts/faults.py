"""Finds faults of a recording that are visible without a model, and leaves out what they touch.

A lost sample, a spike, a frozen channel or a broken last row costs the measurements that it
touches, or the step across it; the rest of the recording is used. What is left out is said in
``Recording.notes``.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.sampling import Sampling, Spans, spans_without_gaps
from npdr_ppl.settings import check_range

__all__ = ["FAULTS", "FaultSettings", "without_faults"]


@dataclass(frozen=True)
class FaultSettings:
    """Limits of what a moving device can do between two measurements.

    Chosen on the public recordings and on simulated Furuta pendulums with swing-ups, impacts and
    rests.

    Attributes:
        jump_size: Second difference that no motion makes, in standard deviations of the channel's
            second differences nearby.
        spike_change: Least size of a spike, in medians of the channel's changes that are not zero.
        mended_share: Share of a departure that may be left after a fault is mended.
        largest_loss: Most samples whose loss is recognised by the jump in time that explains all
            channels. Longer gaps are jumps of most channels.
        left_over: Share of a channel's jump that may be left if its cause is the right one.
        joint_departure: Least departure of a channel that decides, in standard deviations.
        rest_change: A channel rests in a step if it changes by less than this fraction of its
            root-mean-square change.
        least_steps: Least number of steps of a stretch that is checked.
        most_lost: If more than this share of the steps are jumps, they are taken for the device's
            motion.
        frozen_share: A channel is frozen if it keeps its value while it should change by more than
            this share of its range,
        frozen_change: and by more than this many medians of its changes that are not zero.
        least_freeze: Least number of equal measurements of a frozen channel.
    """

    jump_size: float = 12.0
    spike_change: float = 4.0
    mended_share: float = 0.1
    largest_loss: int = 10
    left_over: float = 0.3
    joint_departure: float = 5.0
    rest_change: float = 0.01
    least_steps: int = 20
    most_lost: float = 0.02
    frozen_share: float = 0.1
    frozen_change: float = 4.0
    least_freeze: int = 10

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(
            self, 0.0, 1.0, "rest_change", "most_lost", "frozen_share", "mended_share", "left_over"
        )
        check_range(
            self,
            1,
            1000,
            "jump_size",
            "spike_change",
            "least_steps",
            "frozen_change",
            "least_freeze",
        )


FAULTS = FaultSettings()

WINDOWS = 6, 4
"""Samples on each side of a step to which a parabola is fitted: more average the noise, fewer
follow fast motion."""

LONGER_STEP = 1.5
"""Length of a step across a lost sample in steps beside it: two, less some noise."""

ENCODER_NOISE = 0.3
"""Standard deviation of rounding, in steps of the encoder: 1/√12."""


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
    samplings, spans, notes = [], [], []
    for index, readings in enumerate(rollouts.readings):
        kept = rollouts.samplings[index] if rollouts.samplings else _at_rows(readings)
        found = _Faults(rollouts, index, [*columns.values()], partners, kept)
        samplings.append(found.sampling)
        spans.append(found.spans)
        notes += found.notes
    if not notes:
        return rollouts
    return replace(
        rollouts,
        readings=tuple(
            np.where(sampling.is_read, readings, sampling.values)
            for sampling, readings in zip(samplings, rollouts.readings, strict=True)
        ),
        samplings=tuple(samplings),
        stretches=tuple(spans),
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
            if _is_constant(values(name)) and any(map(_moves_clearly, values(other))):
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


def _moves_clearly(values: Array) -> bool:
    """Returns whether a channel changes by more than its noise, and not only by encoder steps."""
    if len(values) < FAULTS.least_steps:
        return False
    noise = np.sqrt(np.square(np.diff(values, n=2)).mean() / 6.0)
    num_levels = len(np.unique(values))
    return bool(np.ptp(values) > FAULTS.jump_size * noise and num_levels > FAULTS.least_steps)


def _at_rows(readings: Array) -> Sampling:
    shape = readings.shape
    return Sampling(readings.copy(), np.zeros(shape), np.ones(shape, dtype=bool))


class _Faults:
    """The faults of one rollout.

    Attributes:
        sampling: The measurements without those that are wrong.
        spans: The usable stretches.
        notes: What was left out, a sentence each.
    """

    def __init__(
        self,
        rollouts: Rollouts,
        index: int,
        columns: Sequence[int],
        position_of: Mapping[int, int],
        sampling: Sampling,
    ) -> None:
        self.notes: list[str] = []
        self._position_of = position_of
        self._limits = {column: _limits(rollouts, column) for column in columns}
        self._rate_of = {position: rate for rate, position in position_of.items()}
        self._where = f"Rollout {index}"
        self._step = rollouts.time_step
        self._names = rollouts.channel_names
        self._is_read = sampling.is_read.copy()
        self._values = np.array(rollouts.readings[index])
        lost: list[int] = []
        for first, end in rollouts.spans[index]:
            if end - first < FAULTS.least_steps:
                continue
            for column in columns:
                self._leave_out_spikes(first, end, column)
            for column in columns:
                self._leave_out_freezes(first, end, column, columns)
            lost += self._lost_samples(first, end, columns)
        self.sampling, self.spans = sampling, rollouts.spans[index]
        if self.notes:
            values = np.where(self._is_read, sampling.values, self._filled())
            lateness = np.where(self._is_read, sampling.lateness, 0.0)
            self.sampling = Sampling(values, lateness, self._is_read)
            self.spans = _split(self.spans, lost)
            whole = np.zeros_like(self._is_read, dtype=bool)
            whole[:, columns] = True
            usable = spans_without_gaps((self._is_read | ~whole)[:, columns])
            self.spans = _common(self.spans, usable)

    def _filled(self) -> Array:
        """Returns the readings with interpolated values where none is used."""
        rows = np.arange(len(self._values))
        filled = self._values.copy()
        for k in range(filled.shape[1]):
            taken = self._is_read[:, k]
            if taken.any() and not taken.all():
                filled[~taken, k] = np.interp(rows[~taken], rows[taken], filled[taken, k])
        return filled

    def _time(self, row: int) -> str:
        return f"{row * self._step:.4g} s"

    def _leave_out_spikes(self, first: int, end: int, column: int) -> None:
        values = self._values[first : end + 1, column]
        rows = _spikes(values) + first
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

    def _leave_out_freezes(
        self, first: int, end: int, column: int, columns: Sequence[int]
    ) -> None:
        rows = slice(first, end + 1)
        if column in self._rate_of:
            found = self._frozen_positions(rows, column, self._rate_of[column])
        elif column in self._position_of:
            found = self._frozen_rates(rows, column, self._position_of[column])
        else:
            return
        if self._leave_out_limits(rows, column, found):
            return
        for begin, stop in found:
            # The first of the equal values is still right.
            self._is_read[first + begin + 1 : first + stop, column] = False
            self.notes.append(
                f"{self._where}: {self._names[column]} is frozen from "
                f"{self._time(first + begin)} to {self._time(first + stop)}; left out."
            )

    def _leave_out_limits(
        self, rows: slice, column: int, found: Sequence[tuple[int, int]]
    ) -> bool:
        """Leaves out plateaus at the ends of a channel's range, if one is certainly wrong."""
        values = self._values[rows, column]
        limits = self._limits[column]
        if not any(values[begin] in limits for begin, _ in found):
            return False
        at_limit = np.isin(values, limits)
        self._is_read[rows, column] &= ~at_limit
        self.notes.append(
            f"{self._where}: {self._names[column]} looks clipped; {int(at_limit.sum())} "
            "measurements at its limit are left out."
        )
        return True

    def _frozen_positions(self, rows: slice, column: int, rate: int) -> list[tuple[int, int]]:
        """Returns stretches in which a position stays, but its rate says that it moves."""
        values, rates = self._values[rows, column], self._values[rows, rate]
        moved = self._step * np.cumsum(rates)
        least, fastest = _noticeable(values), float(np.abs(rates).max())
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
        least = _noticeable(positions)

        def departure(begin: int, stop: int) -> float:
            moved = values[begin] * self._step * np.arange(stop - begin)
            return float(np.abs(positions[begin:stop] - positions[begin] - moved).max())

        return [span for span in _constant(values) if departure(*span) > least]

    def _pairs_in(self, columns: Sequence[int]) -> list[tuple[int, int]]:
        """Returns places of positions and of their rates among columns."""
        place = {column: k for k, column in enumerate(columns)}
        return [(place[position], place[rate]) for rate, position in self._position_of.items()]

    def _lost_samples(self, first: int, end: int, columns: Sequence[int]) -> list[int]:
        values = self._values[first : end + 1, columns]
        pairs = self._pairs_in(columns)
        swapped = _swapped_rows(values, pairs, self._step)
        if swapped:
            for row in swapped:
                self._is_read[first + row : first + row + 2] = False
            self.notes.append(
                f"{self._where}: neighbouring samples look swapped (pairs: {len(swapped)}, "
                f"the first at {self._time(first + swapped[0])}); left out."
            )
        if _is_last_row_wrong(values):
            self._is_read[end] = False
            self.notes.append(f"{self._where}: the last sample is wrong; left out.")
            values = values[:-1]
        found = set(_lost_steps(values)) | set(_time_jumps(values, pairs, self._step))
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
    """Returns the rows of single wrong measurements of a channel ``(N,)``."""
    departure = np.zeros(len(values))
    departure[2:-2] = (
        values[2:-2] - (-values[:-4] + 4.0 * values[1:-3] + 4.0 * values[3:-1] - values[4:]) / 6.0
    )
    size = np.abs(departure)
    usual = np.maximum(np.median(size[2:-2]), _near(size[:, None])[:, 0]) / 0.6745
    # A device at rest has departures of zero; its encoder still makes single steps.
    changes = np.abs(np.diff(values))
    floor = FAULTS.spike_change * np.median(changes[changes > 0]) if changes.any() else np.inf
    suspicious = np.flatnonzero((size > FAULTS.jump_size * usual) & (size > floor))
    rows = []
    for row in suspicious:
        if size[row] < size[max(0, row - 2) : row + 3].max():
            continue
        mended = values.copy()
        mended[row] -= departure[row]
        around = slice(max(2, row - 1), min(len(values) - 2, row + 2))
        left = (
            mended[around]
            - (
                -mended[around.start - 2 : around.stop - 2]
                + 4.0 * mended[around.start - 1 : around.stop - 1]
                + 4.0 * mended[around.start + 1 : around.stop + 1]
                - mended[around.start + 2 : around.stop + 2]
            )
            / 6.0
        )
        # A step, a kink or an impact is not mended by changing one value.
        if np.abs(left).max() < max(FAULTS.mended_share * size[row], 4.0 * usual[row]):
            rows.append(int(row))
    if len(rows) > FAULTS.most_lost * len(values):
        return np.array([], dtype=np.int64)
    return np.array(rows, dtype=np.int64)


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


def _noticeable(positions: Array) -> float:
    """Returns the displacement from which on a position has moved."""
    changes = np.abs(np.diff(positions))
    usual = float(np.median(changes[changes > 0])) if changes.any() else np.inf
    return max(FAULTS.frozen_share * float(np.ptp(positions)), FAULTS.frozen_change * usual)


def _lost_steps(readings: Array) -> list[int]:
    """Returns the steps across which samples were lost, of readings ``(N, C)``.

    Most channels jump there at once and then continue as usual.
    """
    first = np.diff(readings, axis=0)
    second = np.abs(np.diff(first, axis=0))
    first = np.abs(first)
    rests = first[1:] <= FAULTS.rest_change * np.sqrt(np.square(first[1:]).mean(0))
    # Only steps in which the device moves: it may have rested most of the time.
    moves = rests.mean(1) <= 0.5
    if moves.sum() < FAULTS.least_steps:
        return []
    # Only moving channels can jump; a step of the encoder resolution is no jump.
    moving = np.median(first[1:][moves], axis=0) > 0
    if moving.sum() < 2:
        return []
    usual = _usual_change(first[1:][moves], second[moves])
    # A swing-up beside seconds of balancing is no jump either, so compare with the steps near.
    near = np.maximum(_near(second) / 0.6745, 0.1 * _near(first[1:]))
    jumps = (second > FAULTS.jump_size * np.maximum(usual, near))[:, moving]
    together = jumps.mean(1) > 0.5
    if not together.any() or together.mean() >= FAULTS.most_lost:
        return []
    steps: set[int] = set()
    edges = np.flatnonzero(np.diff(np.concatenate(([0], together.astype(int), [0]))))
    for begin, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        # The second difference k compares the steps k and k + 1. A wrong step shows in two.
        inner = range(begin + 1, stop)
        steps |= set(inner) if len(inner) else {begin, begin + 1}
    # Across lost samples channels go on; at an impact a position turns, and its step is small.
    around = np.maximum(first[:-2], first[2:])[:, moving]
    goes_on = (first[1:-1][:, moving] > LONGER_STEP * around).mean(1) > 0.5
    return sorted(k for k in steps if 0 < k <= len(goes_on) and goes_on[k - 1])


def _time_jumps(readings: Array, pairs: Sequence[tuple[int, int]], time_step: float) -> list[int]:
    """Returns the steps across which a jump in time explains what channels do, ``(N, C)``.

    On both sides of a step, parabolas are fitted. Extended to the middle of the step, they meet,
    if the step has its usual duration. If n samples were lost, they meet when the step is n + 1
    times as long; if a sample was written twice, when it has no duration. At least two channels
    have to agree, or a position with its rate: a position cannot jump.

    Args:
        readings: The readings.
        pairs: Columns of positions and of their rates.
        time_step: Seconds between rows.
    """
    found: set[int] = set()
    for size in WINDOWS:
        steps = _jumps_between(readings, size, pairs, time_step)
        # Windows of different sizes may put a jump one step apart.
        found |= {step for step in steps if not found & {step - 1, step, step + 1}}
    return sorted(found)


def _jumps_between(
    readings: Array, size: int, pairs: Sequence[tuple[int, int]], time_step: float
) -> list[int]:
    """Returns the steps of :func:`_time_jumps` for windows of one size."""
    num, last = len(readings) - 2 * size + 1, size - 1
    if num < FAULTS.least_steps or readings.shape[1] < 2:
        return []
    windows = np.lib.stride_tricks.sliding_window_view(readings, size, axis=0)
    left, right = windows[:num], windows[size : size + num]

    def gap(length: float) -> Array:
        """Returns the distance between the parabolas in the middle of a step, ``(N', C)``."""
        before, after = last + length / 2.0, -length / 2.0
        return left @ _parabola(size, before) - right @ _parabola(size, after)

    usual = gap(1.0)
    noise = _noise(np.abs(usual), readings)
    jumps = np.abs(usual) > FAULTS.joint_departure * noise
    slopes = left @ _parabola(size, last + 0.5, 1), right @ _parabola(size, -0.5, 1)
    is_steady = np.abs(slopes[0] - slopes[1]) < 0.25 * np.abs(slopes[0] + slopes[1])
    rates = 0.5 * (left @ _parabola(size, last + 0.5) + right @ _parabola(size, -0.5))
    votes = np.zeros(num, dtype=bool)
    for length in (0, *range(2, FAULTS.largest_loss + 2)):
        mended = jumps & (np.abs(gap(float(length))) < FAULTS.left_over * np.abs(usual))
        support = (mended & is_steady).sum(1)
        for position, rate in pairs:
            # What the rate says that the position moves in the samples that are missing.
            moved = (1 - length) * time_step * rates[:, rate]
            agrees = np.abs(usual[:, position] - moved) < FAULTS.left_over * np.abs(moved)
            support += mended[:, position] & is_steady[:, position] & agrees
        against = jumps.sum(1) - mended.sum(1)
        votes |= (support >= 2) & (support > 2 * against)
    strength = np.where(jumps, np.abs(usual) / noise, 0.0).sum(1)
    # Windows that contain a jump do not meet either.
    is_jump = votes & (strength >= ndimage.maximum_filter1d(strength, 2 * size + 1))
    steps = np.flatnonzero(is_jump)
    return [] if len(steps) > FAULTS.most_lost * num else (steps + size - 1).tolist()


def _noise(departures: Array, readings: Array) -> Array:
    """Returns the standard deviation of departures near each row, ``(N', C)``.

    Args:
        departures: Absolute departures, ``(N', C)``.
        readings: The readings, whose smallest changes are steps of the encoder, ``(N, C)``.
    """
    usual = np.maximum(np.median(departures, axis=0), _near(departures)) / 0.6745
    changes = np.abs(np.diff(readings, axis=0))
    count = [np.quantile(c[c > 0], 0.1) if (c > 0).any() else np.inf for c in changes.T]
    return np.maximum(usual, ENCODER_NOISE * np.array(count))


@functools.cache
def _parabola(size: int, row: float, derivative: int = 0) -> Array:
    """Returns the weights with which a window gives its parabola, or the slope, at a row.

    Args:
        size: Rows of the window.
        row: Row of the window, from 0; it may lie outside.
        derivative: 0 for the value, 1 for the slope per row.
    """
    at = ([1.0, row, row**2], [0.0, 1.0, 2.0 * row])[derivative]
    powers = np.vander(np.arange(size, dtype=np.float64), 3, increasing=True)
    return np.asarray(np.array(at) @ np.linalg.pinv(powers), dtype=np.float64)


def _swapped_rows(
    readings: Array, pairs: Sequence[tuple[int, int]], time_step: float
) -> list[int]:
    """Returns the first rows of neighbouring samples that were written in the wrong order.

    Arguments and votes are those of :func:`_time_jumps`.
    """
    num = len(readings) - 3
    if num < FAULTS.least_steps or readings.shape[1] < 2:
        return []
    # Across rows k − 1 to k + 2, the middle step goes back by as much as it should go on.
    usual = (readings[3:] - readings[:-3]) / 3.0
    middle = readings[2:-1] - readings[1:-2]
    noise = _noise(np.abs(middle - usual), readings)
    moves = np.abs(usual) > 0.5 * FAULTS.joint_departure * noise
    goes_back = moves & (np.abs(middle + usual) < FAULTS.left_over * np.abs(usual))
    support = goes_back.sum(1)
    for position, rate in pairs:
        moved = time_step * 0.5 * (readings[2:-1, rate] + readings[1:-2, rate])
        agrees = np.abs(middle[:, position] + moved) < FAULTS.left_over * np.abs(moved)
        support += goes_back[:, position] & agrees
    is_swapped = (support >= 2) & (support > 2 * (moves.sum(1) - goes_back.sum(1)))
    rows = np.flatnonzero(is_swapped)
    return [] if len(rows) > FAULTS.most_lost * num else (rows + 1).tolist()


def _is_last_row_wrong(readings: Array) -> bool:
    """Returns whether a channel of the last row lies far from where its motion leads."""
    if len(readings) < FAULTS.least_steps:
        return False
    windows = np.lib.stride_tricks.sliding_window_view(readings, WINDOWS[0], axis=0)[:-1]
    departure = np.abs(readings[WINDOWS[0] :] - windows @ _parabola(WINDOWS[0], float(WINDOWS[0])))
    usual = np.maximum(np.median(departure, axis=0), _near(departure)[-1]) / 0.6745
    changes = np.abs(np.diff(readings, axis=0))
    largest = changes[:-1].max(0)
    is_wrong = (departure[-1] > FAULTS.jump_size * usual) & (
        changes[-1] > np.maximum(FAULTS.spike_change * np.median(changes, axis=0), largest)
    )
    return bool(is_wrong.any())


def _usual_change(first: Array, second: Array) -> Array:
    """Returns the standard deviation of second differences in steady motion, ``(C,)``."""
    return np.maximum(np.median(second, axis=0) / 0.6745, 0.1 * np.median(first, axis=0))


def _near(values: Array) -> Array:
    """Returns the medians of the values around each row, ``(N, C)``."""
    size = 2 * FAULTS.least_steps + 1
    return ndimage.median_filter(values, size=(size, 1), mode="reflect")


def _split(spans: Spans, steps: Sequence[int]) -> Spans:
    """Returns stretches without some of their steps."""
    wrong = set(steps)
    result = []
    for first, end in spans:
        begin = first
        for step in range(first, end):
            if step in wrong:
                if step > begin:
                    result.append((begin, step))
                begin = step + 1
        if end > begin:
            result.append((begin, end))
    return tuple(result)


def _common(one: Spans, other: Spans) -> Spans:
    """Returns what two sets of stretches have in common."""
    both = [(max(a, c), min(b, d)) for a, b in one for c, d in other]
    return tuple((a, b) for a, b in both if a < b)
