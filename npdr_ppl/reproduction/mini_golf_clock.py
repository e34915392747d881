"""The clocks of ball and arm: time stamps of motion capture and joint sensors may differ.

In three strikes of the paper's recordings, the ball moves 30 to 40 ms before the club arrives, in
the fourth 90 ms after. A fit to one strike can compensate for that with other parameters. A joint
fit cannot, because the time offset differs between strikes.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.models.mini_golf import mini_golf
from npdr_ppl.preparation.evaluation import nominal_parameters, replay
from npdr_ppl.reproduction.mini_golf_fit import BALL, OPTIONS
from npdr_ppl.rollouts import Rollouts

__all__ = ["clocks_aligned"]

MOVED = 0.005
"""Distance in m from its place at which the ball counts as struck: far above motion capture's
noise."""


def clocks_aligned(strikes: Rollouts) -> tuple[Rollouts, list[int]]:
    """Shifts the ball's measurements in time, so that it moves when the club reaches it.

    The time of the strike follows from the joint measurements and the ball's place, with an error
    up to the ball's radius over the club's speed, 10 ms. Samples that are missing at the ends
    after the shift repeat the first or last position.

    Args:
        strikes: Whole strikes.

    Returns:
        The strikes, and the delay of each ball in steps.

    Raises:
        DataError: A ball is never struck, in the recording or in simulation.
    """
    nominal = nominal_parameters(mini_golf, strikes.inputs(initial_state="recorded"))
    batched = {name: torch.as_tensor(value)[None] for name, value in nominal.items()}
    simulated = replay(mini_golf, strikes, batched, OPTIONS)
    names = [simulated.channel_names.index(name) for name in BALL]
    delays = [
        _departure(own[0][:, names]) - _departure(measured)
        for own, measured in zip(simulated.series(), strikes.series(BALL), strict=True)
    ]
    columns = [strikes.channel_names.index(name) for name in BALL]
    readings = []
    for values, delay in zip(strikes.readings, delays, strict=True):
        rows = np.clip(np.arange(len(values)) - delay, 0, len(values) - 1)
        shifted = np.array(values)
        shifted[:, columns] = values[rows][:, columns]
        readings.append(shifted)
    return replace(strikes, readings=tuple(readings)), delays


def _departure(positions: Tensor) -> int:
    """Returns the step at which a ball at ``(T, 2)`` has left its place."""
    has_left = (positions - positions[0]).norm(dim=-1) > MOVED
    if not bool(has_left.any()):
        raise DataError("The ball is never struck, so its clock cannot be determined.")
    return int(has_left.double().argmax())
