"""How quickly what was recorded moves."""

import math
from collections.abc import Sequence

import numpy as np

from npdr_ppl.rollouts.arrays import Array

__all__ = ["motion_time"]

BENT = 2.0 * (1.0 - math.cos(1.0))
"""Limit of the mean square of second differences, relative to that of first differences: its value
for a sine sampled one radian apart. White noise has 3 at every lag."""

MOST_LAGS = 200
"""Longest time that is tried, in steps."""

MOST_DIFFERENCES = 20_000
"""Number of differences that are averaged for a lag; more change nothing and take longer."""


def motion_time(stretches: Sequence[Array], time_step: float) -> float:
    """Returns the time in s after which a motion is no longer a straight line.

    Over shorter times, a channel's values follow from the value and the rate at the beginning. A
    sine of frequency f has the time 1/(2π f), which is one radian of its phase. With several
    channels, the median is returned, at most ``MOST_LAGS`` steps. Noise and channels that stand
    still have no such time, and white noise of more than a tenth of the amplitude hides it.
    Without any, 0 is returned.

    Args:
        stretches: Measurements without gaps, ``(N, C)`` each.
        time_step: Seconds between them.
    """
    bent = _bends(stretches)
    lags = [_lag(column) for column in bent.T]
    moving = [lag for lag in lags if lag]
    return time_step * float(np.median(moving)) if moving else 0.0


def _bends(stretches: Sequence[Array]) -> Array:
    """Returns the ratios of :data:`BENT` for each lag from one step, ``(lags, C)``."""
    longest = max(map(len, stretches))
    rows = []
    for lag in range(1, min(MOST_LAGS, (longest - 1) // 2) + 1):
        once = twice = np.zeros(stretches[0].shape[1])
        for values in stretches:
            num = len(values) - 2 * lag
            if num > 0:
                every = slice(None, num, -(-num // MOST_DIFFERENCES))
                first, middle, last = (values[k * lag :][every] for k in range(3))
                once = once + np.square(middle - first).sum(0)
                twice = twice + np.square(last - 2.0 * middle + first).sum(0)
        rows.append(twice / np.maximum(once, 1e-300))
    return np.array(rows).reshape(-1, stretches[0].shape[1])


def _lag(bent: Array) -> int:
    """Returns the first lag at which a channel bends, after lags at which it does not.

    Noise hides short straight lines, so lags before the first straight one are skipped. The lag is
    0 if there is no straight one, or if the channel stands still.
    """
    is_straight = (bent > 0.0) & (bent < BENT)
    if not is_straight.any():
        return 0
    start = int(np.argmax(is_straight))
    is_bent = ~is_straight[start:]
    return start + 1 + int(np.argmax(is_bent)) if is_bent.any() else len(bent)
