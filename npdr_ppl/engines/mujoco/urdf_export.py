"""Writes identified masses, inertias and joint dynamics into the text of a URDF file."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.robot_files import is_urdf, read_robot, references
from npdr_ppl.engines.mujoco.effects_in_file import file_assignments, is_in_file
from npdr_ppl.engines.mujoco.export import ExportedMjcf, written
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mjcf_files import reloaded
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect

__all__ = ["export_urdf"]

Array = NDArray[np.float64]

_DYNAMICS = {"dof_damping": "damping", "dof_frictionloss": "friction"}
"""Attributes of <dynamics> by MuJoCo's arrays."""

_ARMATURE = "dof_armature"

_HINGE = 3
"""MuJoCo's ``mjJNT_HINGE``."""

_INERTIAL = {"body_mass", "body_inertia", "body_ipos", "body_iquat"}

_ENTRIES = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2),
            "iyz": (1, 2)}  # fmt: skip


def export_urdf(simulator: MujocoMechanism, parameters: Mapping[str, Tensor]) -> ExportedMjcf:
    """Writes parameters and effects into the text of a simulator's URDF file.

    A URDF file holds masses, centres of mass and inertias of links, and damping and dry friction
    of joints. All other text stays as it is. The result is loaded again and compared with the
    model. Armatures, for which it has no place, are left out and listed with their values.

    Args:
        simulator: The simulator, effects attached.
        parameters: Values of its parameters and of those of its effects.

    Raises:
        ModelError: The simulator's file is no URDF file, or it has no place for a parameter.
    """
    if simulator.file is None or not is_urdf(files := read_robot(simulator.file)):
        raise ModelError(f"{simulator.name} was not made from a URDF file; export an .xml file.")
    given = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
    before = next(iter(files.texts.values()))
    needs_folder = any(True for tree in files.trees.values() for _ in references(tree))
    kept: list[Effect] = []
    refused: dict[str, str] = {}
    for effect in simulator.effects:
        alone = simulator.carrying((effect,))
        own = {n: given[n] for n in effect.parameter_names if n in given}
        reason = "a URDF file has no place for it; export an .xml file"
        if is_in_file(alone, effect):
            arrays = {array for array, _ in file_assignments(alone, own, (effect,))}
            if arrays <= {*_DYNAMICS, *_INERTIAL}:
                kept.append(effect)
                continue
        refused[effect.name] = reason
    chosen = simulator.carrying(kept)
    own_names = {p.name for p in simulator.parameters}
    own_names |= {name for effect in kept for name in effect.parameter_names}
    assignments = file_assignments(
        chosen, {n: v for n, v in given.items() if n in own_names}, kept
    )
    armatures = [place for array, place in assignments if array == _ARMATURE]
    for dof in armatures:
        joint = simulator.model.joint(int(simulator.model.dof_jntid[dof])).name
        unit = (
            "kg m²" if simulator.model.jnt_type[simulator.model.dof_jntid[dof]] == _HINGE else "kg"
        )
        value = float(assignments.pop((_ARMATURE, dof)))
        refused[f"armature of {joint}, {value:.6g} {unit}"] = (
            "a URDF file has no place for it; set it in your simulator, or export an .xml file"
        )
    text = _new_text(chosen, before, assignments, simulator.file.parent)
    name, folder = simulator.file.name, simulator.file.parent
    return ExportedMjcf(name, folder, before, text, None, refused, needs_folder)


def _new_text(
    simulator: MujocoMechanism, before: str, assignments: Assignments, folder: Path
) -> str:
    """Returns the text with values in it."""
    for array, _ in assignments:
        if array not in _DYNAMICS and array not in _INERTIAL:
            raise ModelError(f"A URDF file has no place for {array}; export an .xml file.")
    old = simulator.model
    new = written(old, assignments)
    edits = MjcfText(before.encode())
    dofs = {place for array, place in assignments if array in _DYNAMICS}
    for dof in sorted(dofs):
        _write_dynamics(edits, old, new, dof)
    bodies = {
        place // int(np.prod(np.shape(getattr(old, array))[1:]))
        for array, place in assignments
        if array in _INERTIAL
    }
    tree = ElementTree.fromstring(before)
    for body in sorted(bodies):
        name = old.body(body).name
        heavy = [link for link in _welded(tree, name) if _has_mass(tree, link)]
        if heavy:
            raise ModelError(
                f"Link {name} is welded to {', '.join(heavy)}, and only their sum was identified; "
                "export an .xml file."
            )
        _write_inertial(edits, old, new, body)
    text = edits.result()
    _check(text, new, folder)
    return text


def _write_dynamics(edits: MjcfText, old: Any, new: Any, dof: int) -> None:
    """Writes damping and dry friction of a joint."""
    joint = _named(edits, "joint", old.joint(int(old.dof_jntid[dof])).name)
    values, notes = {}, []
    for array, attribute in _DYNAMICS.items():
        was, now = float(getattr(old, array)[dof]), float(getattr(new, array)[dof])
        if was != now:
            values[attribute] = repr(now)
            notes.append(f"{attribute} {now:.6g} (was {was:.6g})")
    if not values:
        return
    note = f"npdr: {', '.join(notes)}"
    child = edits.child(joint, "dynamics")
    if child is None:
        words = " ".join(f'{name}="{value}"' for name, value in values.items())
        edits.insert(joint, f"<!-- {note} --> <dynamics {words}/>")
    else:
        edits.set(child, values, note)


def _write_inertial(edits: MjcfText, old: Any, new: Any, body: int) -> None:
    """Writes mass, centre and inertia of a link; the axes of the inertia stay."""
    link = _named(edits, "link", old.body(body).name)
    inertial = edits.child(link, "inertial")
    if inertial is None:
        raise ModelError(f"Link {old.body(body).name} has no <inertial>; give it its mass.")
    origin, mass, inertia = (edits.child(inertial, n) for n in ("origin", "mass", "inertia"))
    if mass is None or inertia is None:
        raise ModelError(f"Link {old.body(body).name} has no mass or no inertia.")
    axes = np.eye(3)
    if origin is not None:
        stated = edits.tags[origin].attributes.get("rpy", "0 0 0")
        axes = _from_rpy(*map(float, stated.split()))
    matrix = axes.T @ _inertia(new, body) @ axes
    parts = (("mass", "body_mass"), ("centre", "body_ipos"), ("inertia", "body_inertia"))
    notes = [
        f"{what} {_short(getattr(new, array)[body])} (was {_short(getattr(old, array)[body])})"
        for what, array in parts
        if not np.array_equal(getattr(old, array)[body], getattr(new, array)[body])
    ]
    if not notes:
        return
    edits.set(mass, {"value": repr(float(new.body_mass[body]))}, f"npdr: {', '.join(notes)}")
    turned = not np.array_equal(old.body_iquat[body], new.body_iquat[body])
    if turned or not np.array_equal(old.body_inertia[body], new.body_inertia[body]):
        edits.set(inertia, {name: repr(float(matrix[at])) for name, at in _ENTRIES.items()})
    if not np.array_equal(old.body_ipos[body], new.body_ipos[body]):
        centre = " ".join(repr(float(x)) for x in new.body_ipos[body])
        if origin is None:
            edits.insert(inertial, f'<origin xyz="{centre}"/>')
        else:
            edits.set(origin, {"xyz": centre})


def _named(edits: MjcfText, kind: str, name: str) -> int:
    """Returns the tag of a link or a joint of the robot."""
    for number in edits.sections(kind):
        if edits.tags[number].attributes.get("name") == name:
            return number
    raise ModelError(f"The file has no {kind} called {name!r}.")


def _welded(tree: ElementTree.Element, link: str) -> Iterable[str]:
    """Returns the links that are fixed to a link, directly or by others."""
    for joint in tree.iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if joint.get("type") != "fixed" or parent is None or child is None:
            continue
        if parent.get("link") == link and (name := child.get("link")):
            yield name
            yield from _welded(tree, name)


def _has_mass(tree: ElementTree.Element, link: str) -> bool:
    masses = [m for e in tree.iter("link") if e.get("name") == link for m in e.iter("mass")]
    return any(float(mass.get("value") or 0.0) > 0.0 for mass in masses)


def _inertia(model: Any, body: int) -> Array:
    """Returns a body's inertia about its centre of mass, along the axes of its frame."""
    w, x, y, z = model.body_iquat[body]
    axes = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    return axes @ np.diag(model.body_inertia[body]) @ axes.T


def _from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Returns the rotation about x, then y, then z of the fixed frame."""
    (a, b, c), (d, e, f) = (fn([roll, pitch, yaw]) for fn in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_z = np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _short(value: Any) -> str:
    return " ".join(f"{float(number):.6g}" for number in np.atleast_1d(value))


def _check(text: str, wanted: Any, folder: Path) -> None:
    """Raises a ModelError if a file does not have the numbers that it should have."""
    found = reloaded(text, ".urdf", folder if "<mesh" in text else None)
    for name in ("body_mass", "body_ipos", "dof_damping", "dof_frictionloss"):
        if not np.allclose(getattr(found, name), getattr(wanted, name), rtol=1e-6, atol=1e-12):
            raise ModelError(
                f"The new file's {name} would differ from the model's; export an .xml file."
            )
    for body in range(found.nbody):
        if not np.allclose(_inertia(found, body), _inertia(wanted, body), rtol=1e-6, atol=1e-12):
            raise ModelError(
                "The new file's inertia would differ from the model's; export an .xml file."
            )
