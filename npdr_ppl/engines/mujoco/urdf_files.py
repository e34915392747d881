"""Models of URDF files as they are: with meshes that are elsewhere, and without actuators."""

import importlib
from os import PathLike
from pathlib import Path
from typing import Any

__all__ = ["MOTOR", "as_mjcf", "compiled_urdf"]

MOTOR = "_motor"
"""What the motor of a joint has behind the joint's name."""

_PACKAGE = "package://"


def compiled_urdf(path: str | PathLike[str]) -> Any:
    """Returns the ``mujoco.MjModel`` of a URDF file, with a motor at every joint.

    A URDF file has no actuators, unless it has an extension for MuJoCo. So each hinge and slide
    gets a motor whose command is the joint's torque in N m or force in N, up to the joint's
    effort.

    A mesh that is neither where the file says nor beside the file is left out. Masses and inertias
    are in the file itself, so that only contacts of that link are lost.

    Args:
        path: The file.

    Raises:
        ValueError: MuJoCo cannot compile it.
    """
    return _spec(path).compile()


def as_mjcf(path: str | PathLike[str]) -> str:
    """Returns the text of an MJCF file with the same model; see :func:`compiled_urdf`."""
    spec = _spec(path)
    spec.compile()
    return str(spec.to_xml())


def _spec(path: str | PathLike[str]) -> Any:
    mujoco: Any = importlib.import_module("mujoco")
    spec = mujoco.MjSpec.from_file(str(path))
    _find_meshes(spec, Path(path).parent)
    if not len(spec.actuators):
        _add_motors(spec)
    return spec


def _find_meshes(spec: Any, folder: Path) -> None:
    """Sets where the meshes are; removes those that cannot be found, with their shapes."""
    missing = set()
    for mesh in list(spec.meshes):
        written = mesh.file.removeprefix(_PACKAGE)
        places = (Path(spec.meshdir or "") / written, Path(written), Path(Path(written).name))
        found = next((place for place in places if (folder / place).is_file()), None)
        if found is None:
            missing.add(mesh.name)
        else:
            mesh.file = str((folder / found).absolute())
    for shape in [*spec.geoms]:
        if shape.meshname in missing:
            spec.delete(shape)
    for mesh in [*spec.meshes]:
        if mesh.name in missing:
            spec.delete(mesh)


def _add_motors(spec: Any) -> None:
    """Adds a motor at every hinge and slide."""
    mujoco: Any = importlib.import_module("mujoco")
    kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    for joint in spec.joints:
        if joint.type not in kinds:
            continue
        motor = spec.add_actuator(name=joint.name + MOTOR, target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.set_to_motor()
        if joint.actfrcrange[0] < joint.actfrcrange[1]:
            motor.ctrllimited, motor.ctrlrange = True, joint.actfrcrange
