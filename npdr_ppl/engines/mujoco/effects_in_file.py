"""Where an effect goes: numbers of an MJCF file, Python beside it, or nowhere."""

from collections.abc import Collection, Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.mujoco.callbacks.python_file import has_dry_friction, law_of
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.parameters import Assignments, present
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import ActionEffect, Effect

__all__ = ["file_assignments", "is_in_file", "why_not"]

LIMIT = "saturation"
"""An effect that simulations apply themselves, and that a file holds, too."""

REASONS = {
    "parameter_drift": "it changes a parameter over minutes; the file has the value at the start",
}
"""Why effects are not written, where there is something to say."""


def is_in_file(simulator: MujocoMechanism, effect: Effect) -> bool:
    """Returns whether an MJCF file can hold an effect.

    Args:
        simulator: The simulator.
        effect: The effect.
    """
    others = [other for other in simulator.effects if other is not effect]
    if effect.id == LIMIT:
        # The file's limit acts behind all Python, so no other law may act on the command.
        return not any(isinstance(e, ActionEffect) and effect.port in e.channels for e in others)
    return simulator.is_native(effect)


def why_not(effect: Effect) -> str | None:
    """Returns why an effect is written nowhere; ``None`` if there is Python for it.

    Args:
        effect: An effect that the file cannot hold.
    """
    try:
        law_of(effect)
    except ModelError as error:
        return REASONS.get(effect.id, str(error))
    return None


def file_assignments(
    simulator: MujocoMechanism,
    parameters: Mapping[str, Tensor],
    chosen: Collection[Effect],
    step: float | None = None,
) -> Assignments:
    """Returns what to write into a simulator's model for its parameters and effects.

    Args:
        simulator: The simulator with all effects that are written, to the file or beside it.
        parameters: Values of parameters, those of effects included, float64 numbers.
        chosen: The effects that the file holds.
        step: Seconds per engine step; the simulator's own by default.
    """
    result, _ = simulator.assignments(parameters, torch.zeros((), dtype=torch.float64), step)
    for effect in simulator.effects:
        values = effect.own_parameters(parameters)
        if has_dry_friction(effect):
            (dof,) = (p.velocity for p in simulator.force_ports if p.port.name == effect.port)
            # Python sets its bounds while it runs; the file has the solver's settings for them.
            result["dof_frictionloss", dof] = present(
                simulator.model, "dof_frictionloss", dof, result
            )
        elif effect.id == LIMIT and effect in chosen:
            actuator = [action.name for action in simulator.actions].index(effect.port)
            channel, limit = simulator.actions[actuator], values["limit"]
            lower, upper = (-limit).clamp_min(channel.lower), limit.clamp_max(channel.upper)
            result["actuator_ctrlrange", 2 * actuator] = lower
            result["actuator_ctrlrange", 2 * actuator + 1] = upper
    return result
