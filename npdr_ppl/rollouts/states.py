"""Estimates values and time derivatives from readings, robust to quantisation and noise."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["StateEstimate", "estimate_departures", "estimate_states", "rate_changes"]

Array = NDArray[np.float64]

DEGREE = 3
"""Degree of the local polynomials; a cubic follows the jerk of a swing-up over tens of samples."""

HALF_WIDTHS = (2, 3, 4, 5, 7, 9, 12, 16, 21, 28, 37, 49, 65, 86, 114, 151, 200)
"""Candidate windows, in samples to each side, growing by about 4/3."""

NEIGHBOURS = (-2, -1, 0, 1, 2)
"""Where else the window is chosen, in samples: the median of the choices is taken, so that one
chance disagreement between small windows does not stop the growth."""

RATE_SAMPLES = 200
"""Steps of each rollout at which the change of a rate is looked at."""

CONFIDENCE = 2.0
"""Half-width of the compared confidence intervals, in standard errors."""

NEGLIGIBLE = 1e-12
"""Share of the largest difference between readings below which one is no count of an encoder."""

ERROR_RATIOS = 3.0, 4.0
"""Root-mean-square errors of values and rates in standard errors: the window grows until bias
shows, so bias is most of the error. Simulated swing-ups with encoders of 2048 counts and up to one
count of noise gave 2.7 to 3.6 for both, recordings with normal noise of four other rigs 2.8 to 3.3
for values and 3.6 to 4.7 for rates."""


@dataclass(frozen=True)
class StateEstimate:
    """Every channel and its time derivative at P steps, ``(P, C)`` each.

    Attributes:
        values: Values, in the channels' units.
        rates: Time derivatives, in units per second.
        value_errors: Standard deviations of the values' errors.
        rate_errors: Standard deviations of the rates' errors.
    """

    values: Array
    rates: Array
    value_errors: Array
    rate_errors: Array


def estimate_states(readings: Array, steps: NDArray[np.int64], time_step: float) -> StateEstimate:
    """Estimates every channel and its time derivative at chosen steps.

    A cubic is fitted to a window around each step. The window is chosen, for each step, channel
    and for value and rate apart, by the intersection of confidence intervals: it grows while its
    interval still meets those of all smaller windows, i.e. until bias shows. No global smoothness
    is assumed, so a swing-up's slow and fast spells each get their own window, and the ends of a
    rollout are windows with one side only.

    Args:
        readings: ``(T + 1, C)``, constant sampling, in the channels' units.
        steps: Indices of the P rows wanted, ``(P,)``.
        time_step: Seconds between rows.

    References:
        A. Goldenshluger and A. Nemirovski, On spatially adaptive estimation of nonparametric
        regression, 1997; V. Katkovnik, A new method for varying adaptive bandwidth selection,
        1999 (the rule).
    """
    value, rate, value_error, rate_error, _ = _adaptive(
        readings, steps, _noises(readings), _num_changes(readings)
    )
    value_error, rate_error = ERROR_RATIOS[0] * value_error, ERROR_RATIOS[1] * rate_error
    return StateEstimate(value, rate / time_step, value_error, rate_error / time_step)


def estimate_departures(
    readings: Array,
    predicted: Sequence[Array],
    first: NDArray[np.int64],
    steps: NDArray[np.int64],
    time_step: float,
) -> StateEstimate:
    """Estimates by how much readings and their rates depart from a prediction at chosen steps.

    What a model leaves of the readings is smoother than they are: where commands change, their
    rates are kinked, which a polynomial takes for a bias and answers with a small window. Where
    nothing but the prediction's end stops a window, errors are the standard errors.

    Args:
        readings: ``(T + 1, C)``, constant sampling, in the channels' units.
        predicted: The same channels predicted around each of P steps, ``(W, C)`` each.
        first: Index of the row that each prediction begins with, ``(P,)``.
        steps: Indices of the rows wanted, ``(P,)``.
        time_step: Seconds between rows.
    """
    noises, num_changes = _noises(readings), _num_changes(readings)
    num_channels = readings.shape[1]
    result = np.empty((4, len(steps), num_channels))
    shapes = [
        (int(step - row), len(window))
        for step, row, window in zip(steps, first, predicted, strict=True)
    ]
    # Windows of one shape are smoothed at once, as channels of one recording.
    for shape in sorted(set(shapes)):
        place, size = shape
        which = [i for i, other in enumerate(shapes) if other == shape]
        rows = first[which, None] + np.arange(size)
        departures = readings[rows] - np.stack([predicted[i] for i in which])
        columns = departures.transpose(1, 0, 2).reshape(size, -1)
        changes = num_changes[rows].transpose(1, 0, 2).reshape(size, -1)
        *found, is_stopped = _adaptive(
            columns, np.array([place]), np.tile(noises, len(which)), changes
        )
        for k, ratio in zip((2, 3), ERROR_RATIOS, strict=True):
            found[k] = np.where(is_stopped[k - 2], ratio, 1.0) * found[k]
        result[:, which] = np.stack(found).reshape(4, len(which), num_channels)
    value, rate, value_error, rate_error = result
    return StateEstimate(value, rate / time_step, value_error, rate_error / time_step)


def rate_changes(readings: Sequence[Array], time_step: float) -> Array:
    """Returns by how much each channel's rate changes in a time step, root mean square, ``(C,)``.

    Args:
        readings: One ``(T + 1, C)`` per rollout, constant sampling, in the channels' units.
        time_step: Seconds between rows.
    """
    changes = []
    for rows in readings:
        steps = np.linspace(0, len(rows) - 2, RATE_SAMPLES).astype(np.int64)
        now, then = (estimate_states(rows, at, time_step).rates for at in (steps, steps + 1))
        changes.append(np.square(then - now))
    return np.sqrt(np.concatenate(changes).mean(0))


def _adaptive(
    readings: Array, steps: NDArray[np.int64], noises: Array, num_changes: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Returns values, rates per row, their standard errors, and what bias stopped; ``(P, C)``.

    The last is ``(2, P, C)``: whether a window of values or of rates could have grown on.
    """
    num_rows = len(readings)
    widths = [w for w in HALF_WIDTHS if w < num_rows] or [HALF_WIDTHS[0]]
    around = np.clip(steps[:, None] + np.array(NEIGHBOURS), 0, num_rows - 1)
    where, which = np.unique(around, return_inverse=True)
    # Axes: window, value or rate, step, channel.
    fits = np.empty((len(widths), 2, len(where), readings.shape[1]))
    errors = np.empty_like(fits)
    for index, width in enumerate(widths):
        fits[index], errors[index] = _fit(readings, where, width, num_changes)
    spread = CONFIDENCE * errors * noises
    meets = np.maximum.accumulate(fits - spread) <= np.minimum.accumulate(fits + spread)
    largest = np.logical_and.accumulate(meets).sum(axis=0) - 1
    chosen = np.median(largest[:, which.reshape(around.shape)], axis=2).astype(int)
    at = np.searchsorted(where, steps)
    value, rate = np.take_along_axis(fits[:, :, at], chosen[None], axis=0)[0]
    error = noises * np.take_along_axis(errors[:, :, at], chosen[None], axis=0)[0]
    return value, rate, error[0], error[1], chosen < len(widths) - 1


def _noises(readings: Array) -> Array:
    return np.array([_noise(channel) for channel in readings.T])


def _num_changes(readings: Array) -> NDArray[np.int64]:
    """Returns how often each channel's reading has changed up to each row, ``(T + 1, C)``."""
    is_change = np.diff(readings, axis=0, prepend=readings[:1]) != 0
    return np.cumsum(is_change, axis=0)


def _fit(
    readings: Array, steps: NDArray[np.int64], half_width: int, num_changes: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Fits one window: value and rate per row, and their standard errors for unit noise.

    Both are ``(2, P, C)``.
    """
    last = len(readings) - 1
    left = np.maximum(steps - half_width, 0)
    right = np.minimum(steps + half_width, last)
    fit = np.empty((2, len(steps), readings.shape[1]))
    error = np.empty_like(fit)
    extents = np.stack([steps - left, right - steps], axis=1)
    for before, after in np.unique(extents, axis=0):
        rows = np.flatnonzero((extents == (before, after)).all(axis=1))
        weights = _weights(int(before), int(after))
        windows = readings[steps[rows, None] + np.arange(-before, after + 1)]
        fit[:, rows] = np.einsum("kn,pnc->kpc", weights, windows)
        # A reading that stays on one encoder count repeats the same error: a window holds only
        # as many independent ones as the reading took values.
        size = before + after + 1
        independent = 1 + num_changes[right[rows]] - num_changes[left[rows]]
        norms = np.linalg.norm(weights, axis=1)
        error[:, rows] = norms[:, None, None] * np.sqrt(size / independent)
    return fit, error


# One-sided windows near a recording's ends have extents of their own, some 1700 in all.
@functools.lru_cache(maxsize=4096)
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
    # A filtered reading that comes to rest fades away below any count.
    size = size[size > NEGLIGIBLE * size.max()]
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
