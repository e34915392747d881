"""Effects that an MJCF file can hold: the numbers of a model that stand for them."""

from collections.abc import Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.language.effects import Effect

__all__ = ["file_assignments", "why_not"]

FRICTION, LIMIT = "coulomb_friction", "saturation"
"""Effects that simulations apply themselves, and that a file holds, too."""

REASONS = {
    "spring": "the joint has a spring already",
    **dict.fromkeys(
        ("encoder_bias", "encoder_scale", "sensor_delay", "sensor_low_pass", "clock_skew"),
        "it is an error of the measurement, which the robot's motion does not have",
    ),
}
"""Why effects are not written, where there is something to say."""


def why_not(simulator: MujocoMechanism, effect: Effect) -> str | None:
    """Returns why an effect is not written into a file; ``None`` if it is.

    Args:
        simulator: The simulator.
        effect: The effect.
    """
    if simulator.is_native(effect) or effect.id in (FRICTION, LIMIT):
        return None
    return REASONS.get(effect.id, "npdr export does not write this law")


def file_assignments(simulator: MujocoMechanism, parameters: Mapping[str, Tensor]) -> Assignments:
    """Returns what to write into a simulator's model for its parameters and effects.

    Args:
        simulator: The simulator, with effects that :func:`why_not` does not refuse.
        parameters: Values of parameters, those of effects included, float64 numbers.
    """
    result, _ = simulator.assignments(parameters, torch.zeros((), dtype=torch.float64))
    for effect in simulator.effects:
        values = effect.own_parameters(parameters)
        if effect.id == FRICTION:
            (dof,) = (p.velocity for p in simulator.force_ports if p.port.name == effect.port)
            own = present(simulator.model, "dof_frictionloss", dof, result)
            result["dof_frictionloss", dof] = own + values["magnitude"]
        elif effect.id == LIMIT:
            actuator = [action.name for action in simulator.actions].index(effect.port)
            channel, limit = simulator.actions[actuator], values["limit"]
            lower, upper = (-limit).clamp_min(channel.lower), limit.clamp_max(channel.upper)
            result["actuator_ctrlrange", 2 * actuator] = lower
            result["actuator_ctrlrange", 2 * actuator + 1] = upper
    return result
