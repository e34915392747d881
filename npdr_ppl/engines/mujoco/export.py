"""Writes identified parameters and effects into the text of an MJCF file."""

import copy
import importlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.robot_files import read_robot, references
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mjcf_edits import MjcfText, flattened
from npdr_ppl.engines.mujoco.native_effects import native_assignments
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.errors import ModelError

__all__ = ["ExportedMjcf", "export_mjcf"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ExportedMjcf:
    """An MJCF file with identified parameters and effects.

    Attributes:
        name: Name of the robot's file.
        folder: Its folder.
        before: The text of the robot's file, with the content of included files in their place.
        text: The new text.
        refused: Why effects are not in it, by the effect's name.
        needs_folder: Whether the text refers to other files, such as meshes, by relative paths.
    """

    name: str
    folder: Path
    before: str
    text: str
    refused: dict[str, str]
    needs_folder: bool


def export_mjcf(simulator: MujocoMechanism, parameters: Mapping[str, Tensor]) -> ExportedMjcf:
    """Writes parameters and effects into the text of a simulator's file.

    Elements get attributes, also where their values came from defaults. All other text stays as
    it is. The result is loaded again, and every number is compared.

    Args:
        simulator: The simulator, effects attached and in the steps in which it was fitted.
        parameters: Values of its parameters and of those of its effects.

    Raises:
        ModelError: The simulator has no file, or a parameter cannot be written into it.
    """
    if simulator.file is None:
        raise ModelError(f"{simulator.name} was made from a compiled model, so it has no file.")
    given = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
    assignments, refused = native_assignments(simulator, given)
    step = simulator.time_step / simulator.num_substeps(simulator.time_step)
    # The solver's settings of dry friction follow from what simulations set, without effects.
    own, _ = simulator.assignments(given, torch.zeros((), dtype=torch.float64))
    model = _written(simulator.prepared(step, set(own)), assignments)
    before = _text_of(simulator)
    edits = _Edits(MjcfText(before.encode()), simulator.model, model)
    for kind in dict.fromkeys(array for array, _ in assignments):
        edits.write(kind, sorted({place for array, place in assignments if array == kind}))
    edits.write_options(step)
    text = edits.text.result()
    file = simulator.file
    _check(text, file.parent, model, assignments)
    trees = read_robot(file).trees.values()
    needs_folder = any(True for tree in trees for _ in references(tree))
    return ExportedMjcf(file.name, file.parent, before, text, refused, needs_folder)


def _text_of(simulator: MujocoMechanism) -> str:
    """Returns the MJCF text of a simulator's file; of a URDF file, what MuJoCo makes of it."""
    file = simulator.file
    assert file is not None
    files = read_robot(file)
    (first, *_) = files.trees
    if files.trees[first].tag != "robot":
        return flattened(files).decode()
    mujoco: Any = importlib.import_module("mujoco")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        mujoco.mj_saveLastXML(str(path), load_mjcf(file))
        return path.read_text(encoding="utf-8")


def _written(model: Any, assignments: Assignments) -> Any:
    """Returns a copy of a model with numbers written into it."""
    changed = copy.copy(model)
    for (array, place), value in assignments.items():
        option = array.removeprefix("opt.")
        if array != option and np.ndim(getattr(changed.opt, option)) == 0:
            setattr(changed.opt, option, float(value))
        else:
            _array(changed, array).reshape(-1)[place] = float(value)
    return changed


def _array(model: Any, name: str) -> Array:
    if name.startswith("opt."):
        return np.atleast_1d(getattr(model.opt, name.removeprefix("opt.")))
    return np.asarray(getattr(model, name))


def _check(text: str, folder: Path, wanted: Any, assignments: Assignments) -> None:
    """Raises a ModelError if a file does not have the numbers that it should have."""
    with tempfile.NamedTemporaryFile("w", suffix=".xml", dir=folder, encoding="utf-8") as file:
        file.write(text)
        file.flush()
        found = load_mjcf(file.name)
    for array, place in assignments:
        one = float(_array(found, array).reshape(-1)[place])
        other = float(_array(wanted, array).reshape(-1)[place])
        if not np.isclose(one, other, rtol=1e-9, atol=1e-12):
            raise ModelError(
                f"{array}[{place}] of the file would be {one:.6g} instead of {other:.6g}; a "
                "setting of the file, such as inertiafromgeom, replaces it."
            )


class _Edits:
    """Turns numbers of a model into attributes.

    Args:
        text: The file's text.
        before: The file's model.
        model: The model with the new numbers.
    """

    def __init__(self, text: MjcfText, before: Any, model: Any) -> None:
        self.text = text
        self.before = before
        self.model = model
        self._degrees = self._angles_are_degrees()
        self._options: dict[str, str] = {}  # of a file that has no such element

    def write(self, array: str, places: Sequence[int]) -> None:
        """Writes the numbers of an array at some places.

        Args:
            array: Its name.
            places: Places in the flat array.
        """
        if array.startswith("opt."):
            name = array.removeprefix("opt.")
            self._option(name, _words(_array(self.model, array)))
            return
        width = int(np.prod(_array(self.model, array).shape[1:]))
        if array not in _WRITERS:
            raise ModelError(f"{array} cannot be written into an MJCF file.")
        for row in sorted({place // width for place in places}):
            _WRITERS[array](self, row)

    def write_options(self, step: float) -> None:
        """Writes the step and the integrator, if they differ from the file's."""
        mujoco: Any = importlib.import_module("mujoco")
        if step != float(self.before.opt.timestep):
            self._option("timestep", repr(step))
        kind = mujoco.mjtIntegrator(self.model.opt.integrator)
        if _parsed(self.text).opt.integrator != self.model.opt.integrator:
            self._option("integrator", kind.name.removeprefix("mjINT_"))

    def _option(self, name: str, value: str) -> None:
        sections = self.text.sections("option")
        if sections:
            self.text.set(sections[-1], {name: value}, f"npdr: {name} {value}")
            return
        self._options[name] = value
        words = " ".join(f'{name}="{value}"' for name, value in self._options.items())
        self.text.insert(0, f"<!-- npdr: added --> <option {words}/>")

    def element(self, kind: str, number: int) -> int:
        """Returns the tag of an element of the world, an actuator or a tendon.

        Args:
            kind: ``"body"``, ``"joint"``, ``"geom"``, ``"site"``, ``"actuator"`` or ``"tendon"``.
            number: Its number in the model.
        """
        section = "worldbody" if kind in ("body", "joint", "geom", "site") else kind
        inside = self.text.within(section)
        if kind == "actuator":
            chosen = [i for i in inside if len(self.text.tags[i].parents) == 2]
            if len(chosen) == int(self.model.nu):
                return chosen[number]
        name = element_names(self.model, kind)[number]
        for i in inside:
            tag = self.text.tags[i]
            is_kind = tag.name == kind or kind in ("actuator", "tendon")
            if is_kind and tag.attributes.get("name") == name:
                return i
        raise ModelError(
            f"The file has no {kind} called {name!r}. Elements need a name, and those that "
            "<replicate>, <attach> or <composite> make cannot be changed one by one."
        )

    def attribute(self, kind: str, number: int, values: Mapping[str, tuple[Any, Any]]) -> None:
        """Sets attributes of an element that change, with a comment.

        Args:
            kind: See :meth:`element`.
            number: Number of the element in the model.
            values: By attribute, the value in the file's model and the new one.
        """
        changed = {n: v for n, v in values.items() if not np.array_equal(*v)}
        if changed:
            written = {name: _words(new) for name, (_, new) in changed.items()}
            self.text.set(self.element(kind, number), written, _note(changed))

    def angle(self, joint: int, value: Any) -> Any:
        """Returns a position of a joint in the unit of the file's angles."""
        mujoco: Any = importlib.import_module("mujoco")
        turns = self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        return np.rad2deg(value) if turns and self._degrees else value

    def inertial(self, body: int) -> None:
        """Writes the inertial element of a body."""
        m, place = self.model, self.element("body", body)
        values = {
            "pos": m.body_ipos[body],
            "quat": m.body_iquat[body],
            "mass": m.body_mass[body],
            "diaginertia": m.body_inertia[body],
        }
        written: dict[str, str | None] = {name: _words(value) for name, value in values.items()}
        note = _note({"mass": (self.before.body_mass[body], m.body_mass[body])})
        child = self.text.child(place, "inertial")
        if child is None:
            words = " ".join(f'{name}="{value}"' for name, value in written.items())
            self.text.insert(place, f"<!-- {note} --> <inertial {words}/>")
            return
        others = ("fullinertia", "euler", "axisangle", "xyaxes", "zaxis")
        present = self.text.tags[child].attributes
        self.text.set(child, written | {name: None for name in others if name in present}, note)

    def gains(self, actuator: int) -> None:
        """Writes the gains of an actuator."""
        place = self.element("actuator", actuator)
        tag = self.text.tags[place]
        (old, old_bias), (new, new_bias) = (
            (m.actuator_gainprm[actuator], m.actuator_biasprm[actuator])
            for m in (self.before, self.model)
        )
        if tag.name == "position" and new_bias[1] == -new[0]:
            gains = {"kp": (old[0], new[0]), "kv": (-old_bias[2], -new_bias[2])}
            self.attribute("actuator", actuator, gains)
            if "dampratio" in tag.attributes:  # it would set kv
                self.text.set(place, {"dampratio": None, "kv": _words(-new_bias[2])})
        elif tag.name in ("velocity", "damper") and new_bias[2] == -new[0]:
            self.attribute("actuator", actuator, {"kv": (old[0], new[0])})
        elif tag.name == "general":
            gains = {"gainprm": (old[:3], new[:3]), "biasprm": (old_bias[:3], new_bias[:3])}
            self.attribute("actuator", actuator, gains)
        else:
            raise ModelError(
                f"The gain of a <{tag.name}> actuator cannot be written; bind its gear instead."
            )

    def _angles_are_degrees(self) -> bool:
        """Returns whether the file's angles are degrees, as they are if it does not say."""
        stated = [
            self.text.tags[i].attributes.get("angle") for i in self.text.sections("compiler")
        ]
        return ([s for s in stated if s] or ["degree"])[-1] == "degree"


def _parsed(text: MjcfText) -> Any:
    """Returns the options that a text states; those of MuJoCo where it states none."""
    mujoco: Any = importlib.import_module("mujoco")
    sections = [dict(text.tags[i].attributes) for i in text.sections("option")]
    integrator = [s["integrator"] for s in sections if "integrator" in s] or ["Euler"]
    bare = f'<mujoco><option integrator="{integrator[-1]}"/></mujoco>'
    return mujoco.MjModel.from_xml_string(bare)


def _words(value: Any) -> str:
    """Returns numbers as the shortest text that is read as the same numbers."""
    return " ".join(repr(float(number)) for number in np.atleast_1d(value))


def _note(changed: Mapping[str, tuple[Any, Any]]) -> str:
    """Returns a comment on changed values."""
    parts = [f"{name} {_short(new)} (was {_short(old)})" for name, (old, new) in changed.items()]
    return f"npdr: {', '.join(parts)}"


def _short(value: Any) -> str:
    return " ".join(f"{float(number):.6g}" for number in np.atleast_1d(value))


def _of_dof(name: str) -> Callable[[_Edits, int], None]:
    def write(edits: _Edits, dof: int) -> None:
        def both(array: str) -> tuple[Any, Any]:
            return tuple(getattr(m, f"dof_{array}")[dof] for m in (edits.before, edits.model))

        values = {name: both(name)}
        if name == "frictionloss":
            # As hard as in the package's simulations, where the friction is an effect.
            values |= {"solreffriction": both("solref"), "solimpfriction": both("solimp")}
        edits.attribute("joint", int(edits.model.dof_jntid[dof]), values)

    return write


def _of(kind: str, array: str, name: str) -> Callable[[_Edits, int], None]:
    def write(edits: _Edits, number: int) -> None:
        old, new = (getattr(model, array)[number] for model in (edits.before, edits.model))
        edits.attribute(kind, number, {name: (old, new)})

    return write


def _rest(edits: _Edits, place: int) -> None:
    (joint,) = map(int, np.flatnonzero(np.asarray(edits.model.jnt_qposadr) == place))
    old, new = (edits.angle(joint, m.qpos_spring[place]) for m in (edits.before, edits.model))
    edits.attribute("joint", joint, {"springref": (old, new)})


def _range(edits: _Edits, joint: int) -> None:
    old, new = (edits.angle(joint, m.jnt_range[joint]) for m in (edits.before, edits.model))
    edits.attribute("joint", joint, {"range": (old, new)})


def _limits(array: str, name: str) -> Callable[[_Edits, int], None]:
    def write(edits: _Edits, actuator: int) -> None:
        old, new = (getattr(model, array)[actuator] for model in (edits.before, edits.model))
        edits.attribute("actuator", actuator, {f"{name}range": (old, new)})
        edits.text.set(edits.element("actuator", actuator), {f"{name}limited": "true"})

    return write


_WRITERS: dict[str, Callable[[_Edits, int], None]] = {
    "dof_damping": _of_dof("damping"),
    "dof_frictionloss": _of_dof("frictionloss"),
    "dof_armature": _of_dof("armature"),
    "jnt_stiffness": _of("joint", "jnt_stiffness", "stiffness"),
    "jnt_pos": _of("joint", "jnt_pos", "pos"),
    "jnt_range": _range,
    "qpos_spring": _rest,
    "body_mass": _Edits.inertial,
    "body_inertia": _Edits.inertial,
    "body_ipos": _Edits.inertial,
    "body_pos": _of("body", "body_pos", "pos"),
    "body_gravcomp": _of("body", "body_gravcomp", "gravcomp"),
    "geom_friction": _of("geom", "geom_friction", "friction"),
    "geom_size": _of("geom", "geom_size", "size"),
    "geom_pos": _of("geom", "geom_pos", "pos"),
    "geom_solref": _of("geom", "geom_solref", "solref"),
    "site_pos": _of("site", "site_pos", "pos"),
    "actuator_gainprm": _Edits.gains,
    "actuator_biasprm": _Edits.gains,
    "actuator_gear": _of("actuator", "actuator_gear", "gear"),
    "actuator_forcerange": _limits("actuator_forcerange", "force"),
    "actuator_ctrlrange": _limits("actuator_ctrlrange", "ctrl"),
    "tendon_stiffness": _of("tendon", "tendon_stiffness", "stiffness"),
    "tendon_damping": _of("tendon", "tendon_damping", "damping"),
    "tendon_frictionloss": _of("tendon", "tendon_frictionloss", "frictionloss"),
    "tendon_armature": _of("tendon", "tendon_armature", "armature"),
}
"""What writes a row of each array of a model."""
