"""Furuta pendulums with one hidden effect that determines whether a policy works.

The random rigs of :mod:`npdr_ppl.models.furuta_targets` have small effects, which many policies
tolerate. Here each rig has one large effect, as on a carelessly built or wired device. Otherwise
it follows the paper's equations.
"""

from typing import Literal, get_args

import numpy as np

from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.randomness import derived_seed

__all__ = ["HIDDEN", "Hidden", "hidden_rig"]

Hidden = Literal["delay", "friction", "dead-zone"]

HIDDEN: tuple[Hidden, ...] = get_args(Hidden)
"""The kinds of hidden effects."""

DELAY = (0.015, 0.025)
"""Range of the delay of the voltage, in s: 8 to 12 control periods, as with a bus and a busy
computer."""

MORE_FRICTION = (3.0, 5.0)
"""Range of the dry friction relative to the random rigs, whose means are the two numbers below."""

ARM_FRICTION, POLE_FRICTION = 1e-3, 1e-4
"""Mean dry friction of the random rigs' joints, in N m."""

DEAD_ZONE = (0.3, 0.6)
"""Range of the half width of the amplifier's dead zone, in V; its limit is ±4 V."""

OFF = 0.15
"""Maximum relative difference of a rig's parameters from the nominal ones."""


def hidden_rig(kind: Hidden, seed: int) -> FurutaRig:
    """Draws a rig with one hidden effect.

    Masses, lengths and the motor are up to 15 % off nominal; dampings lie in the random rigs'
    ranges.

    Args:
        kind: The effect.
        seed: Number of the rig among those of its kind.
    """
    generator = np.random.default_rng(derived_seed(seed, "hidden rig", kind))
    nominal = {parameter.name: parameter.nominal for parameter in Furuta.parameters}
    fixed = ("gravity", "arm_damping", "pole_damping")
    parameters = {
        name: value * generator.uniform(1.0 - OFF, 1.0 + OFF)
        for name, value in nominal.items()
        if name not in fixed
    }
    parameters["arm_damping"] = generator.uniform(0.0, 3e-4)
    parameters["pole_damping"] = generator.uniform(0.0, 3e-5)
    if kind == "delay":
        return FurutaRig(parameters, input_delay=generator.uniform(*DELAY))
    if kind == "dead-zone":
        return FurutaRig(parameters, voltage_dead_zone=generator.uniform(*DEAD_ZONE))
    return FurutaRig(
        parameters,
        arm_friction=ARM_FRICTION * generator.uniform(*MORE_FRICTION),
        pole_friction=POLE_FRICTION * generator.uniform(*MORE_FRICTION),
    )
