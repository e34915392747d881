"""Models of URDF files, which have no actuators, and whose meshes are often elsewhere."""

import importlib
import logging
import os
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

from npdr_ppl.engines.common.robot_files import urdf_mesh
from npdr_ppl.errors import ModelError

__all__ = ["as_mjcf", "compiled_urdf"]

_LOGGER = logging.getLogger(__name__)

_MOTOR = "_motor"
"""What the motor of a joint has behind the joint's name."""

_READABLE = (".stl", ".obj", ".msh")
"""Endings of the meshes that MuJoCo reads."""

_MOST_NAMED = 3
"""Missing meshes that a warning names. A robot without its meshes has one for each link."""


def compiled_urdf(path: str | PathLike[str]) -> Any:
    """Returns the ``mujoco.MjModel`` of a URDF file, with motors.

    A URDF file has no actuators. So each hinge and slide gets a motor, whose command is the
    joint's torque in N m or force in N, up to the joint's effort if that is positive. Joints that
    mimic another one get none.

    A mesh that is nowhere, or in a format that MuJoCo does not read, is left out, and a warning
    says so: a link with an ``<inertial>`` loses its contacts only.

    Args:
        path: The file.

    Raises:
        ModelError: A link without ``<inertial>`` lacks a mesh, from which its mass would follow.
        ValueError: MuJoCo cannot compile it.
    """
    return _spec(path).compile()


def as_mjcf(path: str | PathLike[str]) -> str:
    """Returns the text of an MJCF file in the same folder with the same model.

    Its numbers have six digits; see :func:`compiled_urdf` for the model.
    """
    spec = _spec(path)
    spec.compile()
    return str(spec.to_xml())


def _spec(path: str | PathLike[str]) -> Any:
    mujoco: Any = importlib.import_module("mujoco")
    spec = mujoco.MjSpec.from_file(str(path))
    _find_meshes(spec, Path(path).parent)
    for number, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint_{number}"
    _add_motors(spec)
    return spec


def _find_meshes(spec: Any, folder: Path) -> None:
    """Sets where the meshes are; removes those that are left out, with their shapes."""
    missing: dict[str, str] = {}
    for mesh in spec.meshes:
        found = urdf_mesh(folder, mesh.file, spec.meshdir or "")
        if found is None or found.suffix.lower() not in _READABLE:
            missing[mesh.name] = mesh.file
        else:
            mesh.file = os.path.relpath(found, folder)
    spec.meshdir = ""
    for body in spec.bodies:
        lacking = [shape for shape in body.geoms if shape.meshname in missing]
        if lacking and body.name != "world" and not body.explicitinertial:
            raise ModelError(
                f"link {body.name} has no <inertial>, and its mesh {missing[lacking[0].meshname]} "
                "was not found or cannot be read; give the link its mass and inertia, or copy the "
                "mesh as STL or OBJ beside the file."
            )
        for shape in lacking:
            spec.delete(shape)
    for mesh in list(spec.meshes):
        if mesh.name in missing:
            spec.delete(mesh)
    if missing:
        _say_missing(folder.resolve(), tuple(sorted(set(missing.values()))))


@lru_cache
def _say_missing(folder: Path, names: tuple[str, ...]) -> None:
    """Warns of meshes that are left out, once in a process: a run reads the file many times."""
    listed = ", ".join(names[:_MOST_NAMED])
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    _LOGGER.warning(
        "Links have no contacts where their mesh was not found or cannot be read: %s%s.",
        listed,
        more,
    )


def _add_motors(spec: Any) -> None:
    """Adds a motor at every hinge and slide that moves by itself."""
    mujoco: Any = importlib.import_module("mujoco")
    kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    coupled = {e.name1 for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT}
    for joint in spec.joints:
        if joint.type not in kinds or joint.name in coupled:
            continue
        motor = spec.add_actuator(name=joint.name + _MOTOR, target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.set_to_motor()
        if joint.actfrcrange[0] < joint.actfrcrange[1]:
            motor.ctrllimited, motor.ctrlrange = True, joint.actfrcrange
