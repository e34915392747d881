"""When measurements were taken, where that was not on the uniform grid of a recording."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts.arrays import Array

__all__ = [
    "MOST_BRIDGED",
    "MOST_LATENESS",
    "NEAREST",
    "Placed",
    "Sampling",
    "Spans",
    "common",
    "placed",
    "spans_without_gaps",
    "split",
]

Spans = tuple[tuple[int, int], ...]
"""First step and end of each usable stretch of a rollout."""

MOST_BRIDGED = 3.0
"""Longest gap between two measurements that is bridged, in usual intervals of the channel: three,
or two lost messages. In longer gaps the commands are usually missing, too."""

NEAREST = 0.5
"""Largest distance in time steps between a measurement and the row that is nearest to it."""

MOST_LATENESS = 1.0
"""Largest distance in time steps between a measurement and its row. Simulations are compared with
it by a parabola through the row and its two neighbours, which lie one step away. The error of a
parabola is proportional to x³ − x, and on −1 ≤ x ≤ 1 it is at most 3 % larger than at 0.5."""

LATENESS_PARTS = 2.0**24
"""Lateness is a multiple of a time step divided by this. The time stamp that a file keeps then
gives the same lateness again, in spite of rounding errors, up to 10⁸ rows. At 50 Hz the unit is
1.2 ns, and time stamps are rarely finer than 1 ns."""

MOST_PASSES = 4
"""Largest number of passes in which measurements move to empty rows. With time stamps that depart
by up to half a step, no measurement moves after the second pass."""


@dataclass(frozen=True, eq=False)
class Sampling:
    """The measurements of one rollout as they were taken, ``(T + 1, C)`` each.

    Attributes:
        values: Measurements at their own times; where none was taken, the recording's reading,
            which is interpolated there.
        lateness: Time of each measurement minus the time of its row, in time steps, from −1 to 1;
            zero where none was taken. It is beyond ±0.5 only where the nearest row has another
            measurement.
        is_read: Whether a measurement was taken.
    """

    values: Array
    lateness: Array
    is_read: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Makes the arrays read-only and checks them; raises a ``DataError``."""
        shape = self.values.shape
        if self.lateness.shape != shape or self.is_read.shape != shape:
            raise DataError("the parts of a sampling have different shapes.")
        if not (np.abs(self.lateness) <= MOST_LATENESS + 1e-9).all():
            raise DataError("a measurement is more than a time step away from its row.")
        for part in (self.values, self.lateness, self.is_read):
            part.flags.writeable = False

    @classmethod
    def at_rows(cls, readings: Array) -> "Sampling":
        """Returns the sampling of readings that were all taken at the times of their rows."""
        shape = readings.shape
        return cls(readings.copy(), np.zeros(shape), np.ones(shape, dtype=bool))

    @property
    def is_regular(self) -> bool:
        """Whether all measurements were taken at the times of the rows."""
        return bool(self.is_read.all()) and not self.lateness.any()

    def rows(self, first: int, end: int) -> "Sampling":
        """Returns the sampling of some rows only."""
        values, lateness, is_read = self.values, self.lateness, self.is_read
        rows = slice(first, end)
        return Sampling(values[rows].copy(), lateness[rows].copy(), is_read[rows].copy())

    def channels(self, columns: Sequence[int]) -> "Sampling":
        """Returns the sampling of some channels only."""
        values, lateness, is_read = self.values, self.lateness, self.is_read
        chosen = list(columns)
        return Sampling(values[:, chosen], lateness[:, chosen], is_read[:, chosen])

    def with_unread(self, values: Array) -> "Sampling":
        """Returns the sampling with further channels ``(T + 1, k)`` that were not measured."""
        shape = values.shape
        return Sampling(
            np.hstack((self.values, values)),
            np.hstack((self.lateness, np.zeros(shape))),
            np.hstack((self.is_read, np.zeros(shape, dtype=bool))),
        )


class Placed(NamedTuple):
    """One channel's measurements on T + 1 rows.

    Attributes:
        values: The measurements, zero where there is none, ``(T + 1,)``.
        lateness: Time of each measurement minus that of its row, in time steps, ``(T + 1,)``.
        is_read: Whether there is a measurement, ``(T + 1,)``.
        num_unused: Number of measurements that found no row.
    """

    values: Array
    lateness: Array
    is_read: NDArray[np.bool_]
    num_unused: int


def placed(place: Array, values: Array, num_rows: int) -> Placed:
    """Puts one channel's measurements on the rows of a grid, at most one on each row.

    A measurement belongs to the nearest row. If several do, one of them moves to an empty row, if
    no measurement gets further than ``MOST_LATENESS`` from its row; those in between move up.
    Of measurements that still share a row, the nearest one is kept.

    Args:
        place: Increasing times of the measurements, in time steps after the first row, ``(N,)``.
        values: The measurements, ``(N,)``.
        num_rows: Number of rows, T + 1.
    """
    place = np.rint(place * LATENESS_PARTS) / LATENESS_PARTS
    # Halves are rounded up, so that a clock that runs between the rows meets each of them.
    nearest = np.floor(place + NEAREST)
    inside = (nearest >= 0) & (nearest < num_rows)
    num = int(inside.sum())
    inside &= np.diff(place, prepend=-np.inf) > 0
    place, values = place[inside], values[inside]
    row = _spread(place, nearest[inside].astype(np.int64), num_rows)
    late = place - row
    # The nearest is written last.
    order = np.argsort(-np.abs(late), kind="stable")
    found, lateness = np.zeros(num_rows), np.zeros(num_rows)
    is_read = np.zeros(num_rows, dtype=bool)
    found[row[order]], lateness[row[order]] = values[order], late[order]
    is_read[row] = True
    return Placed(found, lateness, is_read, num - int(is_read.sum()))


def _spread(place: Array, row: NDArray[np.int64], num_rows: int) -> NDArray[np.int64]:
    """Returns the rows of measurements after some of those that share one have moved.

    Args:
        place: Increasing times of the measurements in time steps, ``(N,)``.
        row: Nearest row of each, ``(N,)``.
        num_rows: Number of rows.
    """
    for _ in range(MOST_PASSES):
        before = row
        row = _moved_up(place, row, num_rows)
        # Backwards in time, the earlier rows are the later ones.
        row = (
            num_rows
            - 1
            - _moved_up(num_rows - 1 - place[::-1], num_rows - 1 - row[::-1], num_rows)[::-1]
        )
        if np.array_equal(row, before):
            break
    return row


def _moved_up(place: Array, row: NDArray[np.int64], num_rows: int) -> NDArray[np.int64]:
    """Returns rows of which empty ones are filled from earlier ones with several measurements.

    The last measurement of each row from the one with several to the one before the empty row
    moves to the next row, provided that each was taken at its own row or later: it is then at most
    one step before its new row. Arguments are those of :func:`_spread`.
    """
    count = np.bincount(row, minlength=num_rows)
    empty, several = np.flatnonzero(count == 0), np.flatnonzero(count > 1)
    if not len(empty) or not len(several):
        return row
    last = np.cumsum(count) - 1
    may_move = (count > 0) & (place[last.clip(0)] >= np.arange(num_rows))
    nearest = np.searchsorted(several, empty) - 1
    source, empty = several[nearest.clip(0)], empty[nearest >= 0]
    source = source[nearest >= 0]
    num_stuck = np.concatenate(([0], np.cumsum(~may_move)))
    is_open = num_stuck[empty] == num_stuck[source]
    change = np.zeros(len(row) + 1, dtype=np.int64)
    change[last[source[is_open]]] += 1
    change[last[empty[is_open] - 1] + 1] -= 1
    return row + np.cumsum(change[:-1])


def split(spans: Spans, steps: Iterable[int]) -> Spans:
    """Returns stretches without some of their steps.

    Args:
        spans: The stretches.
        steps: The steps that are not usable.
    """
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


def common(one: Spans, other: Spans) -> Spans:
    """Returns what two sets of stretches have in common."""
    both = [(max(a, c), min(b, d)) for a, b in one for c, d in other]
    return tuple((a, b) for a, b in both if a < b)


def spans_without_gaps(is_read: NDArray[np.bool_]) -> Spans:
    """Returns the stretches of a rollout in which no channel has a long gap.

    Args:
        is_read: Whether a measurement was taken, ``(T + 1, C)``.
    """
    num_steps = len(is_read) - 1
    is_usable = np.ones(num_steps, dtype=bool)
    for channel in is_read.T:
        rows = np.flatnonzero(channel)
        if len(rows) < 2:
            return ()
        intervals = np.diff(rows)
        usual = np.median(intervals)
        for k in np.flatnonzero(intervals > MOST_BRIDGED * usual):
            is_usable[rows[k] : rows[k + 1]] = False
        # Before the first and after the last measurement the channel is not known.
        is_usable[: rows[0]] = False
        is_usable[rows[-1] :] = False
    edges = np.flatnonzero(np.diff(np.concatenate(([0], is_usable.astype(np.int8), [0]))))
    return tuple((int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True))
