"""Gravity as a vector, so that a base which is not level can tilt it."""

from torch import Tensor

__all__ = ["GravityVector", "downward"]

GravityVector = tuple[Tensor | float, Tensor | float, Tensor | float]
"""Acceleration of gravity along x, y and z (up) of the base, in m/s².

A component given as the number 0.0 is left out of the equations and needs no computation.
"""


def downward(gravity: Tensor) -> GravityVector:
    """Returns the vector of gravity on a level base.

    Args:
        gravity: Magnitude, in m/s².
    """
    return 0.0, 0.0, -gravity
