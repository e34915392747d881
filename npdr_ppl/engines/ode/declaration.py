"""Checks of what the author of a mechanical system declared and wrote."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.errors import ModelError

__all__ = ["check_accelerations", "check_declaration"]


def check_declaration(system: ClosedLoopSimulator, joints: Sequence[str]) -> None:
    """Checks joints, ports and the order of the states.

    Args:
        system: The system.
        joints: Names of its force ports, one for each coordinate.

    Raises:
        ModelError: One of them does not fit the others; the message says how to mend it.
    """
    name = system.name
    if not joints:
        raise ModelError(
            f"{name} declares no joints; name its force ports, one for each coordinate: "
            'joints = ("x_force", "y_force").'
        )
    forces = [port.name for port in system.ports if port.kind == "force"]
    for joint in joints:
        if joint not in forces:
            known = f"those are {', '.join(forces)}" if forces else "it has none"
            raise ModelError(
                f"The joint {joint!r} of {name} is not among its ports of kind force; {known}. "
                f'Declare npdr.Port({joint!r}, "force", unit), or name another port in joints.'
            )
    states, num = system.states, len(joints)
    wanted = tuple(state.name for state in states[:num])
    if len(states) != 2 * num or tuple(state.rate_of for state in states[num:]) != wanted:
        raise ModelError(
            f"{name} has {num} joints, so its states are {num} positions and then their "
            f"velocities in the same order, each with rate_of; got "
            f"{', '.join(state.name for state in states)}."
        )


def check_accelerations(
    system: ClosedLoopSimulator,
    joints: Sequence[str],
    accelerations: Callable[..., tuple[Tensor, ...]],
    constants: Any,
) -> None:
    """Evaluates the accelerations once, at rest and with nominal parameters.

    Args:
        system: The system.
        joints: Names of its force ports, one for each coordinate.
        accelerations: Returns the acceleration of each joint.
        constants: Its last argument, for nominal parameters.

    Raises:
        ModelError: They ask for a constant that does not exist, or ignore a force.
    """
    rest = tuple(torch.zeros(1, dtype=torch.float64) for _ in joints)
    actions = tuple(torch.zeros(1, dtype=torch.float64) for _ in system.actions)
    units = torch.eye(len(rest), dtype=torch.float64)
    try:
        free, *pushed = (
            torch.stack(
                [
                    torch.as_tensor(each, dtype=torch.float64).reshape(-1)[:1]
                    for each in accelerations(
                        rest, rest, actions, tuple(force[None] for force in forces), constants
                    )
                ]
            )
            for forces in (torch.zeros(len(rest), dtype=torch.float64), *units)
        )
    except KeyError as error:
        known = f"; it has {', '.join(constants)}" if isinstance(constants, dict) else ""
        raise ModelError(
            f"{system.name}.accelerations() asks for the constant {error}{known}."
        ) from error
    for number, (joint, reached) in enumerate(zip(joints, pushed, strict=True)):
        if bool((reached == free).all()):
            raise ModelError(
                f"{system.name}.accelerations() ignores the force at {joint}; add "
                f"forces[{number}] to the joint's own forces, because effects act through it."
            )
