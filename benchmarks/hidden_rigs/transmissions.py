"""What may lie between a motor and its link: two masses, joined by a shaft or with play."""

from collections.abc import Callable, Mapping

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["TRANSMISSIONS", "Transmission"]

_ForceOf = Callable[[Mapping[str, float], float, float], Callable[[Array, Array], Array]]
"""Makes s of the parameters, the reduced inertia ρ (1 − ρ) J and the seconds per substep."""


class Transmission:
    """The inertia ρ J on the motor's side, and the force s(δ, δ̇) that it exerts on the link.

    Args:
        parameters: The effect's true parameters.
        inertia: Inertia J that a force at the joint sees, in kg m² or kg.
        substep: Seconds per substep of the integration.
        force_of: Makes s.

    Attributes:
        motor_inertia: ρ J.
        force: s as a function of how far the motor is ahead, and the rate of that.
    """

    def __init__(
        self,
        parameters: Mapping[str, float],
        inertia: float,
        substep: float,
        force_of: _ForceOf,
    ) -> None:
        share = parameters["motor_share"]
        self.motor_inertia = share * inertia
        # Two masses on a spring swing with the reduced one.
        self.force = force_of(parameters, share * (1.0 - share) * inertia, substep)


def _shaft(
    p: Mapping[str, float], reduced: float, substep: float
) -> Callable[[Array, Array], Array]:
    """A spring and a damper, given by the resonance of the free masses."""
    frequency = 1.0 / p["time_constant"]
    stiffness = reduced * frequency**2
    damping = 2.0 * p["damping_ratio"] * reduced * frequency
    return lambda ahead, rate: stiffness * ahead + damping * rate


def _play(
    p: Mapping[str, float], reduced: float, substep: float
) -> Callable[[Array, Array], Array]:
    """Nothing within ±g, and beyond it flanks that meet without a bounce.

    They are as stiff as the substeps allow: softer ones give way by more than a small play, and
    then the recording is one of an elastic joint.
    """
    frequency = 1.0 / substep
    stiffness, damping = reduced * frequency**2, 2.0 * reduced * frequency

    def force(ahead: Array, rate: Array) -> Array:
        depth = np.abs(ahead) - p["play"]
        # While they touch they also pull, as with grease between: if they did not, they would part
        # with an eighth of the speed that they met with.
        push = stiffness * depth + damping * np.sign(ahead) * rate
        return np.where(depth > 0.0, np.sign(ahead) * push, 0.0)

    return force


TRANSMISSIONS: dict[str, _ForceOf] = {"joint_elasticity": _shaft, "backlash": _play}
"""Laws by the effect's id."""
