"""What may lie between a motor and its link: two masses, joined by a shaft or with play."""

from collections.abc import Callable, Mapping

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["TRANSMISSIONS", "Transmission"]

# Seconds over 2π that the flanks of a gear take to swing on each other. A gear is stiffer, and
# this is stiff enough: the flanks give way by a thousandth of a typical play.
_CONTACT_TIME = 1.0e-3


class Transmission:
    """The inertia ρ J on the motor's side, and the force s(δ, δ̇) that it exerts on the link.

    Args:
        parameters: The effect's true parameters.
        inertia: Inertia J that a force at the joint sees, in kg m² or kg.
        force_of: Makes s of the parameters and the reduced inertia ρ (1 − ρ) J.

    Attributes:
        motor_inertia: ρ J.
        force: s as a function of how far the motor is ahead, and the rate of that.
    """

    def __init__(
        self,
        parameters: Mapping[str, float],
        inertia: float,
        force_of: Callable[[Mapping[str, float], float], Callable[[Array, Array], Array]],
    ) -> None:
        share = parameters["motor_share"]
        self.motor_inertia = share * inertia
        # Two masses on a spring swing with the reduced one.
        self.force = force_of(parameters, share * (1.0 - share) * inertia)


def _shaft(p: Mapping[str, float], reduced: float) -> Callable[[Array, Array], Array]:
    """A spring and a damper, given by the resonance of the free masses."""
    frequency = 1.0 / p["time_constant"]
    stiffness = reduced * frequency**2
    damping = 2.0 * p["damping_ratio"] * reduced * frequency
    return lambda ahead, rate: stiffness * ahead + damping * rate


def _play(p: Mapping[str, float], reduced: float) -> Callable[[Array, Array], Array]:
    """Nothing within ±g, and beyond it flanks that are stiff and meet without a bounce."""
    frequency = 1.0 / _CONTACT_TIME
    stiffness, damping = reduced * frequency**2, 2.0 * reduced * frequency

    def force(ahead: Array, rate: Array) -> Array:
        depth = np.abs(ahead) - p["play"]
        push = stiffness * depth + damping * np.sign(ahead) * rate
        # Flanks push and never pull.
        return np.where(depth > 0.0, np.sign(ahead) * np.maximum(push, 0.0), 0.0)

    return force


TRANSMISSIONS: dict[
    str, Callable[[Mapping[str, float], float], Callable[[Array, Array], Array]]
] = {"joint_elasticity": _shaft, "backlash": _play}
"""Laws by the effect's id."""
