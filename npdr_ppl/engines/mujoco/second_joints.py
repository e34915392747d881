"""Second joints on the axes of a robot's joints, for carriers that yield.

The second joint is a part of the MJCF file, so the engine knows how it moves every link, and that
gravity, the mass matrix and the drives of all joints change with it. Which of two joints on one
axis comes first does not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.common.robot_files import read_robot
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.mjcf_edits import Edits
from npdr_ppl.engines.mujoco.mjcf_files import mjcf_text, reloaded
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText
from npdr_ppl.errors import ModelError

__all__ = ["SecondJoint", "WithSecondJoints", "with_second_joints"]

_ENDING = "_carrier"
"""What a second joint's name has behind that of the first."""

_IMMOVABLE = 1e12
"""Armature of second joints in the text, in kg m² or kg; simulations set their own."""


class SecondJoint(NamedTuple):
    """Where a model has a second joint.

    Attributes:
        joint: Its number.
        position: Its index in qpos.
        velocity: Its index in qvel.
    """

    joint: int
    position: int
    velocity: int


@dataclass(frozen=True)
class WithSecondJoints:
    """A model with second joints.

    Attributes:
        text: Its MJCF text.
        model: The ``mujoco.MjModel``.
        seconds: The second joint of each of the chosen joints, in their order.
        joints: New number of each joint of the model without them.
        positions: New index of each number in qpos.
        velocities: New index of each number in qvel.
    """

    text: str
    model: Any
    seconds: tuple[SecondJoint, ...]
    joints: NDArray[np.int64]
    positions: NDArray[np.int64]
    velocities: NDArray[np.int64]


def with_second_joints(file: Path | None, model: Any, joints: Sequence[int]) -> WithSecondJoints:
    """Returns a file's model in which some joints have a second one on the same axis.

    Args:
        file: The MJCF or URDF file.
        model: Its ``mujoco.MjModel``.
        joints: Numbers of the joints, hinges or slides.

    Raises:
        ModelError: There is no file, or a joint has no name in it.
    """
    if file is None:
        raise ModelError("A compiled model has no file, so that no joint can be added to it.")
    text = MjcfText(mjcf_text(file, read_robot(file)).encode())
    edits, names = Edits(text, model, model), element_names(model, "joint")
    added = {f"{names[joint]}{_ENDING}": joint for joint in joints}
    clash = sorted(added.keys() & set(names))
    if clash:
        raise ModelError(f"{file.name} has a joint called {clash[0]!r} already.")
    by_body: dict[int, list[str]] = {}
    for name, joint in added.items():
        holder = edits.element("joint", joint)
        while text.tags[holder].name != "body":  # positions in a <frame> are other ones
            holder = text.tags[holder].parent
        by_body.setdefault(holder, []).append(_element(name, model, joint))
    for holder, elements in by_body.items():
        text.insert(holder, " ".join(elements))
    changed = text.result()
    found = reloaded(changed, ".xml", file.parent)
    found_names = element_names(found, "joint")
    kept = [j for j, name in enumerate(found_names) if name not in added]
    if [found_names[j] for j in kept] != names:
        raise ModelError(f"Every joint of {file.name} needs a name, so that one can be added.")
    seconds = tuple(
        SecondJoint(j, int(found.jnt_qposadr[j]), int(found.jnt_dofadr[j]))
        for j in map(found_names.index, added)
    )
    own = {s.position for s in seconds}, {s.velocity for s in seconds}
    return WithSecondJoints(
        changed,
        found,
        seconds,
        np.array(kept),
        np.array([i for i in range(found.nq) if i not in own[0]]),
        np.array([i for i in range(found.nv) if i not in own[1]]),
    )


def _element(name: str, model: Any, joint: int) -> str:
    """Returns the element of a joint on the axis of another; it has no default's properties."""
    kind = "slide" if int(model.jnt_type[joint]) == 2 else "hinge"
    place, axis = (
        " ".join(repr(float(x)) for x in array[joint]) for array in (model.jnt_pos, model.jnt_axis)
    )
    return (
        f"<!-- npdr: a second joint, for what carries {name.removesuffix(_ENDING)} --> "
        f'<joint name="{name}" type="{kind}" pos="{place}" axis="{axis}" limited="false" ref="0" '
        f'springref="0" stiffness="0" damping="0" frictionloss="0" armature="{_IMMOVABLE}"/>'
    )
