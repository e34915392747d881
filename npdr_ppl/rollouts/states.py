"""Estimates values and time derivatives from readings, robust to quantisation and noise."""

import functools

import numpy as np
from numpy.typing import NDArray

__all__ = ["estimate_states"]

Array = NDArray[np.float64]

DEGREE = 3
"""Degree of the local polynomials; a cubic follows the jerk of a swing-up over tens of samples."""

HALF_WIDTHS = (2, 3, 4, 5, 7, 9, 12, 16, 21, 28, 37, 49, 65, 86, 114, 151, 200)
"""Candidate windows, in samples to each side, growing by about 4/3."""

CONFIDENCE = 2.0
"""Half-width of the compared confidence intervals, in standard errors."""


def estimate_states(
    readings: Array, steps: NDArray[np.int64], time_step: float
) -> tuple[Array, Array]:
    """Estimates every channel and its time derivative at chosen steps.

    A cubic is fitted to a window around each step. The window is chosen for each step and channel
    by the intersection of confidence intervals: it grows while the interval of its derivative
    still meets those of all smaller windows, i.e. until bias shows. No global smoothness is
    assumed, so a swing-up's slow and fast spells each get their own window.

    Args:
        readings: ``(T + 1, C)``, constant sampling, in the channels' units.
        steps: Indices of the P rows wanted, ``(P,)``.
        time_step: Seconds between rows.

    Returns:
        Values, and rates in units per second, ``(P, C)`` each.

    References:
        A. Goldenshluger and A. Nemirovski, On spatially adaptive estimation of nonparametric
        regression, 1997; V. Katkovnik, A new method for varying adaptive bandwidth selection,
        1999 (the rule).
    """
    num_rows, num_channels = readings.shape
    noise = np.array([_noise(readings[:, c]) for c in range(num_channels)])
    is_change = np.concatenate([np.zeros((1, num_channels)), np.diff(readings, axis=0) != 0])
    num_changes = np.cumsum(is_change, axis=0)
    shape = (len(steps), num_channels)
    values, rates = np.zeros(shape), np.zeros(shape)
    lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
    is_growing = np.ones(shape, dtype=bool)
    for half_width in HALF_WIDTHS:
        value, rate, error = _fit(readings, steps, half_width, num_changes)
        spread = CONFIDENCE * error * noise
        new_lower = np.maximum(lower, rate - spread)
        new_upper = np.minimum(upper, rate + spread)
        is_growing &= new_lower <= new_upper
        values = np.where(is_growing, value, values)
        rates = np.where(is_growing, rate, rates)
        lower, upper = new_lower, new_upper
        if not is_growing.any() or half_width >= num_rows:
            break
    return values, rates / time_step


def _fit(
    readings: Array, steps: NDArray[np.int64], half_width: int, num_changes: Array
) -> tuple[Array, Array, Array]:
    """Fits one window: value, rate per row, and the rate's standard error for unit noise."""
    last = len(readings) - 1
    left = np.maximum(steps - half_width, 0)
    right = np.minimum(steps + half_width, last)
    value = np.empty((len(steps), readings.shape[1]))
    rate, error = np.empty_like(value), np.empty_like(value)
    extents = np.stack([steps - left, right - steps], axis=1)
    for before, after in np.unique(extents, axis=0):
        rows = np.flatnonzero((extents == (before, after)).all(axis=1))
        weights = _weights(int(before), int(after))
        windows = readings[steps[rows, None] + np.arange(-before, after + 1)]
        fitted = np.einsum("kn,pnc->kpc", weights, windows)
        value[rows], rate[rows] = fitted
        # A reading that stays on one encoder count repeats the same error: a window holds only
        # as many independent ones as the reading took values.
        size = before + after + 1
        independent = 1 + num_changes[right[rows]] - num_changes[left[rows]]
        error[rows] = np.linalg.norm(weights[1]) * np.sqrt(size / independent)
    return value, rate, error


@functools.lru_cache(maxsize=1024)
def _weights(before: int, after: int) -> Array:
    """Returns the weights ``(2, before + after + 1)`` of a window for value and rate per row."""
    offsets = np.arange(-before, after + 1, dtype=np.float64)
    scale = max(before, after, 1)
    degree = min(DEGREE, before + after)
    powers = np.vander(offsets / scale, degree + 1, increasing=True)
    weights = np.linalg.pinv(powers)[:2].astype(np.float64)
    weights[1] /= scale
    return weights


def _noise(readings: Array) -> float:
    """Returns the standard deviation of one channel's reading errors.

    The larger of what third differences show, where any smooth motion is negligible, and of the
    error of rounding to the encoder's count, which a motion at rest would hide.
    """
    differences = np.diff(readings)
    size = np.abs(differences[differences != 0])
    if size.size == 0:
        return 0.0
    noise = 0.0
    third = np.diff(differences, n=2)
    third = third[differences[1:-1] != 0]
    if third.size:
        # Independent errors of variance s² have third differences of variance 20 s²; the median
        # of their absolute values, for normal errors, is 0.6745 standard deviations.
        noise = float(np.median(np.abs(third))) / 0.6745 / np.sqrt(20)
    count = float(size.min())
    remainder = np.abs(size / count - np.round(size / count))
    if np.mean(remainder < 0.05) > 0.95:
        noise = max(noise, count / np.sqrt(12))
    return noise
