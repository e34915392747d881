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


class _Known(dict[str, Any]):
    """Constants that say so if one is asked for that does not exist."""

    def __missing__(self, key: str) -> Any:
        raise _UnknownError(key)


class _UnknownError(Exception):
    """A constant does not exist."""


def check_accelerations(
    system: ClosedLoopSimulator,
    joints: Sequence[str],
    accelerations: Callable[..., tuple[Tensor, ...]],
    constants: Any,
    like: Tensor,
) -> None:
    """Evaluates the accelerations once, at rest and with nominal parameters.

    Nothing is said of accelerations that cannot be computed there for another reason than those
    below.

    Args:
        system: The system.
        joints: Names of its force ports, one for each coordinate.
        accelerations: Returns the acceleration of each joint.
        constants: Its last argument, for nominal parameters.
        like: A tensor of the type and on the device of the simulation.

    Raises:
        ModelError: They ask for a constant that does not exist, are not one for each joint, or
            ignore a force.
    """
    zero = like.new_zeros(1)
    rest, actions = (zero,) * len(joints), (zero,) * len(system.actions)
    known = _Known(constants) if isinstance(constants, dict) else constants
    free = None
    for number, joint in enumerate(("", *joints)):
        forces = tuple(zero + float(other == joint) for other in joints)
        try:
            found = [
                torch.as_tensor(each).reshape(-1)[:1].to(zero)
                for each in accelerations(rest, rest, actions, forces, known)
            ]
        except _UnknownError as error:
            raise ModelError(
                f"{system.name}.accelerations() asks for the constant {str(error)!r}; it has "
                f"{', '.join(constants)}."
            ) from error
        except Exception:  # the simulation itself shows it
            return
        if len(found) != len(joints):
            raise ModelError(
                f"{system.name}.accelerations() returns {len(found)} accelerations for "
                f"{len(joints)} joints."
            )
        if free is None:
            free = torch.cat(found)
        elif bool((torch.cat(found) == free).all()):
            raise ModelError(
                f"{system.name}.accelerations() ignores the force at {joint}; add "
                f"forces[{number - 1}] to the joint's own forces, because effects act through it."
            )
