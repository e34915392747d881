"""When measurements were taken, where that was not on the uniform grid of a recording."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts.arrays import Array

__all__ = ["Sampling", "Spans", "common", "placed", "spans_without_gaps", "split"]

Spans = tuple[tuple[int, int], ...]
"""First step and end of each usable stretch of a rollout."""

MOST_BRIDGED = 3.0
"""Longest gap between two measurements that is bridged, in usual intervals of the channel: three,
or two lost messages. In longer gaps the commands are usually missing, too."""


@dataclass(frozen=True, eq=False)
class Sampling:
    """The measurements of one rollout as they were taken, ``(T + 1, C)`` each.

    Attributes:
        values: Measurements at their own times; where none was taken, the recording's reading,
            which is interpolated there.
        lateness: Time of each measurement minus the time of its row, in time steps, from −0.5 to
            0.5; zero where none was taken.
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
        if not (np.abs(self.lateness) <= 0.5 + 1e-9).all():
            raise DataError("a measurement is more than half a step away from its row.")
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


def placed(time: Array, values: Array, grid: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Puts one channel's measurements on the nearest rows of a grid.

    Of several measurements nearest to the same row, the nearest one is kept.

    Args:
        time: Increasing times of the measurements in s, ``(N,)``.
        values: The measurements, ``(N,)``.
        grid: Times of the rows in s, at equal distances, ``(T + 1,)``.

    Returns:
        Values, lateness in steps, and whether there is a measurement, ``(T + 1,)`` each; values
        and lateness are zero where there is none.
    """
    step = (grid[-1] - grid[0]) / (len(grid) - 1)
    place = (time - grid[0]) / step
    # Halves are rounded up, so that a clock that runs between the rows meets each of them.
    row = np.floor(place + 0.5 + 1e-9).astype(np.int64)
    inside = (row >= 0) & (row < len(grid))
    place, row, values = place[inside], row[inside], values[inside]
    late = place - row
    # The nearest is written last.
    order = np.argsort(-np.abs(late), kind="stable")
    found, lateness = np.zeros(len(grid)), np.zeros(len(grid))
    is_read = np.zeros(len(grid), dtype=bool)
    found[row[order]], lateness[row[order]] = values[order], late[order]
    is_read[row] = True
    # Stamps are rounded; a billionth of a step is no lateness.
    lateness[np.abs(lateness) < 1e-9] = 0.0
    return found, lateness, is_read


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
