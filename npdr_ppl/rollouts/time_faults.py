"""Faults of a recording in time: lost, repeated and swapped samples, and a wrong last row.

All are found in several channels together, which no motion of a device moves in this way.
"""

import functools
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.fault_settings import FAULTS

__all__ = ["is_last_row_wrong", "lost_steps", "near", "swapped_rows", "time_jumps"]

WINDOWS = 6, 4
"""Samples on each side of a step to which a parabola is fitted: more average the noise, fewer
follow fast motion."""

LONGER_STEP = 1.5
"""Length of a step across a lost sample in steps beside it: two, less some noise."""

ENCODER_NOISE = 0.3
"""Standard deviation of rounding, in steps of the encoder: 1/√12."""


def lost_steps(readings: Array) -> list[int]:
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
    around = np.maximum(near(second) / 0.6745, 0.1 * near(first[1:]))
    jumps = (second > FAULTS.jump_size * np.maximum(usual, around))[:, moving]
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


def time_jumps(readings: Array, pairs: Sequence[tuple[int, int]], time_step: float) -> list[int]:
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
    usual = np.maximum(np.median(departures, axis=0), near(departures)) / 0.6745
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


def swapped_rows(readings: Array, pairs: Sequence[tuple[int, int]], time_step: float) -> list[int]:
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


def is_last_row_wrong(readings: Array) -> bool:
    """Returns whether a channel of the last row lies far from where its motion leads."""
    if len(readings) < FAULTS.least_steps:
        return False
    windows = np.lib.stride_tricks.sliding_window_view(readings, WINDOWS[0], axis=0)[:-1]
    departure = np.abs(readings[WINDOWS[0] :] - windows @ _parabola(WINDOWS[0], float(WINDOWS[0])))
    usual = np.maximum(np.median(departure, axis=0), near(departure)[-1]) / 0.6745
    changes = np.abs(np.diff(readings, axis=0))
    largest = changes[:-1].max(0)
    is_wrong = (departure[-1] > FAULTS.jump_size * usual) & (
        changes[-1] > np.maximum(FAULTS.spike_change * np.median(changes, axis=0), largest)
    )
    return bool(is_wrong.any())


def _usual_change(first: Array, second: Array) -> Array:
    """Returns the standard deviation of second differences in steady motion, ``(C,)``."""
    return np.maximum(np.median(second, axis=0) / 0.6745, 0.1 * np.median(first, axis=0))


def near(values: Array) -> Array:
    """Returns the medians of values ``(N, C)`` around each row, ``(N, C)``."""
    size = 2 * FAULTS.least_steps + 1
    return ndimage.median_filter(values, size=(size, 1), mode="reflect")
