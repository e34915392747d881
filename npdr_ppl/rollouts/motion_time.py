"""How quickly what was recorded moves."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import correlate

from npdr_ppl.rollouts.arrays import Array

__all__ = ["motion_time"]

RADIAN = math.cos(1.0)
"""Autocorrelation of a sine after one radian of its phase."""


def motion_time(stretches: Sequence[Array], time_step: float) -> float:
    """Returns the time in s in which a motion goes through one radian of its main wave.

    It is the first time after which the autocorrelation of a channel is that of a sine after one
    radian, 1/(2π f) for a frequency f; and the median of several channels. A channel whose
    neighbouring measurements correlate less than that is noise, and one that never changes is
    none; they do not count. If none is left, the time is 0.

    Args:
        stretches: Measurements without gaps, ``(N, C)`` each.
        time_step: Seconds between them.
    """
    columns = range(stretches[0].shape[1])
    lags = [_lag([values[:, column] for values in stretches]) for column in columns]
    moving = [lag for lag in lags if lag > 1]
    return time_step * float(np.median(moving)) if moving else 0.0


def _lag(tracks: Sequence[Array]) -> int:
    """Returns the first lag in steps at which the autocorrelation is below that of a radian.

    Each track departs from its own mean. The lag is 0 if nothing changes, and the length of the
    longest track if there is no such lag.
    """
    longest = max(map(len, tracks))
    products, pairs = np.zeros(longest), np.zeros(longest)
    for track in tracks:
        num, departures = len(track), track - track.mean()
        products[:num] += correlate(departures, departures)[num - 1 :]
        pairs[:num] += np.arange(num, 0, -1)
    covariance = products / pairs
    if covariance[0] <= 0.0:
        return 0
    is_below = covariance < RADIAN * covariance[0]
    return int(np.argmax(is_below)) if is_below.any() else longest
