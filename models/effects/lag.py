"""The first-order lag that actuators and filters share."""

import torch
from torch import Tensor

__all__ = ["remaining"]

# exp(-1000) is zero even in float64. Time constants below a thousandth of a step therefore give no
# lag at all, and the gradient at zero exists.
_STEPS_PER_LEAST_TIME_CONSTANT = 1000.0


def remaining(time_constant: Tensor, time_step: float) -> Tensor:
    """Returns exp(−h/T), the share that remains after a step of h seconds; exactly 0 for T = 0.

    Args:
        time_constant: Time constant T, in seconds.
        time_step: Length of the step h, in seconds.
    """
    least = time_step / _STEPS_PER_LEAST_TIME_CONSTANT
    return torch.exp(-time_step / time_constant.clamp_min(least))
