"""Second joints on the axes of a robot's joints, for carriers that yield.

The second joint is a part of the MJCF file, directly before the joint. So the engine knows how all
links, weights and drives react to its motion.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import torch
from numpy.typing import NDArray

from npdr_ppl.engines.common.robot_files import read_robot
from npdr_ppl.engines.mujoco.channels import Component
from npdr_ppl.engines.mujoco.damping import drive_damping
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.mjcf_edits import Edits
from npdr_ppl.engines.mujoco.mjcf_files import folder_of_assets, mjcf_text, reloaded
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText, Tag
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.engines.mujoco.ports import ForcePort
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Carrier

__all__ = ["IMMOVABLE", "SecondJoint", "WithSecondJoints", "with_second_joints"]

IMMOVABLE = 1e12
"""Inertia so large that forces do not move it noticeably, in kg m² or kg."""

_LEAST_TIME_CONSTANT = 2.0
"""Least time constant of a carrier alone, in engine steps. Explicit steps are stable down to half
a step."""

_MOST_DAMPED = 1.0
"""Greatest damping ratio of a carrier. With the least time constant, explicit steps are stable up
to a ratio of 2.5."""


class SecondJoint(NamedTuple):
    """Where a model has a second joint.

    Attributes:
        joint: Its number.
        position: Its index in qpos.
        velocity: Its index in qvel.
        first: Number of the first joint.
        first_velocity: Index of the first joint in qvel.
    """

    joint: int
    position: int
    velocity: int
    first: int
    first_velocity: int

    def assignments(
        self, model: Any, carrier: Carrier, step: float, others: Assignments
    ) -> Assignments:
        """Returns what to write into the model for a carrier.

        The carrier is made heavier where explicit steps would be unstable: where it would swing
        within two steps, or where the drive's damping would stop it within one. The damping's rate
        then grows by at most one per step, so that steps of order four are stable up to a rate of
        1.7 without the carrier.

        Args:
            model: The ``mujoco.MjModel``.
            carrier: The carrier.
            step: Seconds per engine step.
            others: Other values to write; a changed place or axis of the first joint also holds
                for the second.
        """
        damping = drive_damping(model, self.first_velocity, others)
        time = carrier.time_constant.clamp_min(_LEAST_TIME_CONSTANT * step)
        inertia = torch.maximum(time**2 * carrier.stiffness, damping * step)
        ratio = carrier.damping_ratio.clamp_max(_MOST_DAMPED)
        placed = {
            (array, 3 * self.joint + place % 3): value
            for (array, place), value in others.items()
            if array in ("jnt_pos", "jnt_axis") and place // 3 == self.first
        }
        return placed | {
            ("jnt_stiffness", self.joint): carrier.stiffness,
            ("dof_damping", self.velocity): 2.0 * ratio * torch.sqrt(inertia * carrier.stiffness),
            ("dof_armature", self.velocity): inertia,
        }


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

    def component(self, old: Component) -> Component:
        """Returns a component of the state at its new address."""
        table = self.velocities if old.is_velocity else self.positions
        return replace(old, address=int(table[old.address]))

    def port(self, old: ForcePort) -> ForcePort:
        """Returns a joint's port at its new address."""
        return replace(
            old,
            joint=int(self.joints[old.joint]),
            position=None if old.position is None else int(self.positions[old.position]),
            velocity=int(self.velocities[old.velocity]),
        )

    def pose(self, old: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns positions ``qpos`` in which no spring of a second joint is bent."""
        return _spread(old, self.positions, len(self.seconds))


def with_second_joints(file: Path | None, model: Any, joints: Sequence[int]) -> WithSecondJoints:
    """Returns a file's model in which some joints have a second one on the same axis.

    Args:
        file: The MJCF or URDF file.
        model: Its ``mujoco.MjModel``.
        joints: Numbers of the joints, hinges or slides.

    Raises:
        ModelError: There is no file, a joint has no name in it, or it cannot be written.
    """
    if file is None:
        raise ModelError("A compiled model has no file, so that no joint can be added to it.")
    files = read_robot(file)
    text = MjcfText(mjcf_text(file, files).encode())
    edits, names = Edits(text, model, model), element_names(model, "joint")
    own = {joint: f"{names[joint]}_carrier" for joint in joints}
    clash = sorted(set(own.values()) & set(names))
    if clash:
        raise ModelError(f"{file.name} has a joint called {clash[0]!r} already.")
    for joint, name in own.items():
        place = edits.element("joint", joint)
        note = f"npdr: what carries {names[joint]}".replace("--", "- -")
        text.insert_before(place, f"<!-- {note} --> {_element(name, text.tags[place])}")
    positions = _shifted(model.nq, [int(model.jnt_qposadr[joint]) for joint in joints])
    velocities = _shifted(model.nv, [int(model.jnt_dofadr[joint]) for joint in joints])
    for i in (i for i, tag in enumerate(text.tags) if tag.name == "key"):
        for attribute, table in (("qpos", positions), ("qvel", velocities)):
            if attribute in text.tags[i].attributes:
                old = np.array(text.tags[i].attributes[attribute].split(), dtype=float)
                new = _spread(old, table, len(joints))
                text.set(i, {attribute: " ".join(repr(float(number)) for number in new)})
    changed = text.result()
    found = reloaded(changed, ".xml", folder_of_assets(file, files))
    # Beside a joint that nothing moves, the constraint solver would end too early.
    found.opt.tolerance = 0.0
    found_names = element_names(found, "joint")
    kept = [j for j, name in enumerate(found_names) if name not in own.values()]
    if [found_names[j] for j in kept] != names:
        raise ModelError(f"Every joint of {file.name} needs a name, so that one can be added.")
    seconds = tuple(
        SecondJoint(
            second := found_names.index(name),
            int(found.jnt_qposadr[second]),
            int(found.jnt_dofadr[second]),
            kept[joint],
            int(velocities[model.jnt_dofadr[joint]]),
        )
        for joint, name in own.items()
    )
    return WithSecondJoints(changed, found, seconds, np.array(kept), positions, velocities)


def _shifted(size: int, places: Sequence[int]) -> NDArray[np.int64]:
    """Returns new indices of numbers, before some of which another one is inserted."""
    old = np.arange(size)
    return old + (np.array(places)[:, None] <= old).sum(0)


def _spread(old: NDArray[np.float64], table: NDArray[np.int64], more: int) -> NDArray[np.float64]:
    """Returns numbers at new indices, with zeros between them."""
    new = np.zeros(len(old) + more)
    new[table] = old
    return new


def _element(name: str, first: Tag) -> str:
    """Returns a second joint's element: placed as the first, without its forces and limits."""
    mujoco: Any = importlib.import_module("mujoco")
    # Later versions of the engine have springs and dampers of higher order.
    none = "0 0 0" if hasattr(mujoco.MjModel, "jnt_stiffnesspoly") else "0"
    placed = {n: v for n, v in first.attributes.items() if n in ("type", "pos", "axis", "class")}
    attributes = placed | {
        "name": name,
        "limited": "false",
        "actuatorfrclimited": "false",
        "actuatorgravcomp": "false",
        "ref": "0",
        "springref": "0",
        "springdamper": "0 0",
        "stiffness": none,
        "damping": none,
        "frictionloss": "0",
        "armature": repr(IMMOVABLE),
    }
    return f"<joint {' '.join(f'{n}={quoteattr(v)}' for n, v in attributes.items())}/>"
