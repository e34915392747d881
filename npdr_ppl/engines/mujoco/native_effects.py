"""Effects that an MJCF file can hold: the numbers of a model that stand for them."""

from collections.abc import Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.native_laws import present
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.language.effects import Effect

__all__ = ["native_assignments"]

NO_SUCH_LAW = "MuJoCo has no such law"

REASONS = {
    "spring": "the joint has a spring already",
    **dict.fromkeys(
        ("encoder_bias", "encoder_scale", "sensor_delay", "sensor_low_pass", "clock_skew"),
        "it is an error of the measurement, which the robot's motion does not have",
    ),
}
"""Why effects cannot be written, where there is more to say than ``NO_SUCH_LAW``."""


def native_assignments(
    simulator: MujocoMechanism, parameters: Mapping[str, Tensor]
) -> tuple[Assignments, dict[str, str]]:
    """Returns what to write into a simulator's model for its parameters and effects.

    Args:
        simulator: The simulator, effects attached.
        parameters: Values of parameters, those of effects included, float64 numbers.

    Returns:
        The numbers, and why other effects cannot be written, by the effect's name.
    """
    result, _ = simulator.assignments(parameters, torch.zeros((), dtype=torch.float64))
    refused: dict[str, str] = {}
    for effect in simulator.effects:
        values = effect.own_parameters(parameters)
        if simulator.is_native(effect):
            continue  # it is among the simulator's own assignments
        if effect.id == "coulomb_friction":
            result |= _friction(simulator, effect, values, result)
        elif effect.id == "saturation":
            result |= _saturation(simulator, effect, values)
        else:
            refused[effect.name] = REASONS.get(effect.id, NO_SUCH_LAW)
    return result, refused


def _friction(
    simulator: MujocoMechanism, effect: Effect, values: Mapping[str, Tensor], result: Assignments
) -> Assignments:
    (dof,) = (p.velocity for p in simulator.force_ports if p.port.name == effect.port)
    own = present(simulator.model, "dof_frictionloss", dof, result)
    return {("dof_frictionloss", dof): own + values["magnitude"]}


def _saturation(
    simulator: MujocoMechanism, effect: Effect, values: Mapping[str, Tensor]
) -> Assignments:
    names = [action.name for action in simulator.actions]
    actuator, limit = names.index(effect.port), values["limit"]
    channel = simulator.actions[actuator]
    return {
        ("actuator_ctrlrange", 2 * actuator): (-limit).clamp_min(channel.lower),
        ("actuator_ctrlrange", 2 * actuator + 1): limit.clamp_max(channel.upper),
    }
