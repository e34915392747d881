"""Motions that repeat, and waves in step with them.

Whatever depends on the state of a motion that repeats is a sum of waves with its period. A wave in
time that keeps in step with it is therefore no disturbance from outside, but what a law of the
state looks like that the catalogue does not have.
"""

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.language.effects import Effect
from npdr_ppl.rollouts import Rollouts

__all__ = ["keeps_in_step", "period_of"]

REPEATS = 0.1
"""Change after a period, in the change between unrelated moments, below which a motion repeats."""

FORGETS = 0.5
"""Such a change from which a motion has left where it was, and a period can end."""

MOST_POINTS = 1_000
"""Points of a rollout that periods are sought among; the best is then refined."""

SLIPS = 0.25
"""Turns by which a wave in step is ahead or behind at the end of a rollout."""

Array = NDArray[np.float64]


def keeps_in_step(hypothesis: Hypothesis, effect: Effect, rollouts: Rollouts) -> bool:
    """Returns whether an effect is a wave that repeats whenever the motion does.

    Args:
        hypothesis: A fitted model with the effect.
        effect: The effect.
        rollouts: The recording.
    """
    if not effect.wave:
        return False
    frequency = float(hypothesis.parameters[f"{effect.name}.{effect.wave}"])
    return all(
        _is_in_step(frequency, readings, rollouts.time_step) for readings in rollouts.readings
    )


def _is_in_step(frequency: float, readings: Array, time_step: float) -> bool:
    period = period_of(readings)
    if period is None:
        return False
    turns = frequency * period * time_step
    slip = abs(turns - round(turns)) * len(readings) / period
    return round(turns) > 0 and slip < SLIPS


def period_of(readings: Array) -> int | None:
    """Returns the steps after which all channels repeat, ``None`` if they do not.

    Args:
        readings: Readings ``(T, C)``; a period that is longer than half of them is not seen.
    """
    spread = np.sqrt(2.0) * readings.std(0)
    moving = spread > 0
    if not moving.any():
        return None
    scaled = readings[:, moving] / spread[moving]

    def change(lag: int) -> float:
        return float(np.sqrt(np.square(scaled[lag:] - scaled[:-lag]).mean(0).max()))

    stride = max(1, len(scaled) // MOST_POINTS)
    lags = range(stride, len(scaled) // 2 + 1, stride)
    changes = np.array([change(lag) for lag in lags])
    left = np.flatnonzero(changes > FORGETS)
    if not len(left):
        return None
    back = np.flatnonzero(changes[left[0] :] < REPEATS)
    if not len(back):
        return None
    first = left[0] + back[0]
    until = first + int(np.argmax(np.append(changes[first:] > FORGETS, True)))
    best = lags[first + int(np.argmin(changes[first:until]))]
    return min(range(max(1, best - stride), best + stride + 1), key=change)
