"""Periodic motions and commands, and waves that are synchronous with them.

Along a periodic motion, any function of the state is a sum of waves with the same period. Under a
periodic command, so is any function of the command, and the driven motion tends to the same
period. A synchronous wave in time is therefore no external disturbance. It indicates a law of the
state or of the command that the catalogue does not have.
"""

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.settings import REPETITION
from npdr_ppl.language.effects import Effect
from npdr_ppl.rollouts import Rollouts

__all__ = ["keeps_in_step", "period_of"]


Array = NDArray[np.float64]


def keeps_in_step(hypothesis: Hypothesis, effect: Effect, rollouts: Rollouts) -> bool:
    """Returns whether an effect is a wave that is synchronous with the motion or the commands.

    Args:
        hypothesis: A fitted model with the effect.
        effect: The effect.
        rollouts: The recording.
    """
    if not effect.wave:
        return False
    frequency = float(hypothesis.parameters[f"{effect.name}.{effect.wave}"])
    return any(
        all(_is_in_step(frequency, values, rollouts.time_step) for values in signals)
        for signals in (rollouts.usable_readings, rollouts.usable_actions)
    )


def _is_in_step(frequency: float, values: Array, time_step: float) -> bool:
    period = period_of(_without_rest(values))
    if period is None:
        return False
    turns = frequency * period * time_step
    slip = abs(turns - round(turns)) * len(values) / period
    return round(turns) > 0 and slip < REPETITION.largest_phase_error


def _without_rest(values: Array) -> Array:
    """Returns values from their first change to their last one."""
    changes = np.flatnonzero(np.any(values[1:] != values[:-1], axis=1))
    return values[changes[0] : changes[-1] + 2] if len(changes) else values[:1]


def period_of(values: Array) -> int | None:
    """Returns the number of steps after which all columns repeat, ``None`` if they do not.

    Args:
        values: Measurements or commands, ``(T, C)``; a period longer than half of them is not
            found.
    """
    spread = np.sqrt(2.0) * values.std(0)
    moving = spread > 0
    if not moving.any():
        return None
    scaled = values[:, moving] / spread[moving]

    def change(lag: int) -> float:
        return float(np.sqrt(np.square(scaled[lag:] - scaled[:-lag]).mean(0).max()))

    stride = max(1, len(scaled) // REPETITION.most_points)
    lags = range(stride, len(scaled) // 2 + 1, stride)
    changes = np.array([change(lag) for lag in lags])
    left = np.flatnonzero(changes > REPETITION.departed_change)
    if not len(left):
        return None
    back = np.flatnonzero(changes[left[0] :] < REPETITION.periodic_change)
    if not len(back):
        return None
    first = left[0] + back[0]
    until = first + int(np.argmax(np.append(changes[first:] > REPETITION.departed_change, True)))
    best = lags[first + int(np.argmin(changes[first:until]))]
    return min(range(max(1, best - stride), best + stride + 1), key=change)
