"""Writes identified parameters and effects into the text of an MJCF file."""

import copy
import importlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.robot_files import RobotFiles, read_robot, references
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.effects_in_file import file_assignments, why_not
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mjcf_edits import MjcfText, flattened
from npdr_ppl.engines.mujoco.parameters import Assignments
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect

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


def export_mjcf(
    simulator: MujocoMechanism,
    parameters: Mapping[str, Tensor],
    *,
    time_step: float | None = None,
) -> ExportedMjcf:
    """Writes parameters and effects into the text of a simulator's file.

    A changed value is written at the element itself, even if a default class set it before. All
    other text stays as it is. The result is loaded again and compared with the model.

    Args:
        simulator: The simulator, effects attached and in the steps in which it was fitted.
        parameters: Values of its parameters and of those of its effects.
        time_step: Seconds per step of the recording; the simulator's own by default.

    Raises:
        ModelError: The simulator has no file, or a parameter cannot be written into it.
    """
    if simulator.file is None:
        raise ModelError(f"{simulator.name} was made from a compiled model, so it has no file.")
    given = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
    time_step = time_step or simulator.time_step
    step = time_step / simulator.num_substeps(time_step)
    files = read_robot(simulator.file)
    before = _text_of(simulator.file, files)
    needs_folder = any(True for tree in files.trees.values() for _ in references(tree))
    place = simulator.file.parent if needs_folder else None
    kept, refused = _effects_that_fit(simulator, given, before, step, place)
    chosen = copy.copy(simulator)
    chosen.effects = kept
    text = _new_text(chosen, given, before, step, place)
    return ExportedMjcf(
        simulator.file.name, simulator.file.parent, before, text, refused, needs_folder
    )


def _effects_that_fit(
    simulator: MujocoMechanism,
    given: Mapping[str, Tensor],
    before: str,
    step: float,
    place: Path | None,
) -> tuple[tuple[Effect, ...], dict[str, str]]:
    """Returns the effects that the file can hold, and why it cannot hold the others.

    Each is tried by itself; see :func:`_new_text` for the arguments.
    """
    kept: list[Effect] = []
    refused: dict[str, str] = {}
    alone = copy.copy(simulator)
    for effect in simulator.effects:
        reason = why_not(simulator, effect)
        if reason is None:
            alone.effects = (effect,)
            own = {n: given[n] for n in effect.parameter_names if n in given}
            try:
                _new_text(alone, own, before, step, place)
            except ModelError as error:
                reason = str(error).rstrip(".")
        if reason is None:
            kept.append(effect)
        else:
            refused[effect.name] = reason
    return tuple(kept), refused


def _new_text(
    simulator: MujocoMechanism,
    given: Mapping[str, Tensor],
    before: str,
    step: float,
    place: Path | None,
) -> str:
    """Returns the text with values in it.

    Args:
        simulator: The simulator with the effects to write.
        given: Values of parameters, float64 numbers.
        before: The text without them.
        step: Seconds per engine step.
        place: Folder in which the text finds the files that it refers to.

    Raises:
        ModelError: A value cannot be written.
    """
    effects = {name for effect in simulator.effects for name in effect.parameter_names}
    own = {p.name for p in simulator.parameters} | effects
    given = {name: value for name, value in given.items() if name in own}
    assignments = file_assignments(simulator, given)
    # The solver's settings of dry friction follow from what simulations set, without effects.
    set_anyway, _ = simulator.assignments(given, torch.zeros((), dtype=torch.float64))
    model = _written(simulator.prepared(step, set(set_anyway)), assignments)
    edits = _Edits(MjcfText(before.encode()), simulator.model, model)
    for array in dict.fromkeys(array for array, _ in assignments):
        edits.write(array, sorted({place for name, place in assignments if name == array}))
    edits.keep_damping()
    edits.write_options(step)
    text = edits.text.result()
    _check(text, place, model)
    return text


def _text_of(file: Path, files: RobotFiles) -> str:
    """Returns the MJCF text of a robot's file; of a URDF file, what MuJoCo makes of it."""
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


_COMPARED = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia",
    "body_gravcomp", "jnt_pos", "jnt_axis", "jnt_stiffness", "jnt_stiffnesspoly", "jnt_range",
    "qpos0", "qpos_spring", "dof_damping", "dof_dampingpoly", "dof_armature", "dof_frictionloss",
    "geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref", "site_pos",
    "actuator_gainprm", "actuator_biasprm", "actuator_dynprm", "actuator_gear",
    "actuator_forcerange", "actuator_ctrlrange", "tendon_stiffness", "tendon_damping",
    "tendon_frictionloss", "tendon_armature", "tendon_lengthspring",
    "opt.gravity", "opt.wind", "opt.density", "opt.viscosity", "opt.timestep", "opt.integrator",
)  # fmt: skip
"""Arrays of a model that the motion follows from."""


def _check(text: str, place: Path | None, wanted: Any) -> None:
    """Raises a ModelError if a file does not have the numbers that it should have.

    Args:
        text: The file's text.
        place: Folder in which it finds the files that it refers to; any if ``None``.
        wanted: The model that it should describe.
    """
    with tempfile.TemporaryDirectory(dir=place, prefix=".npdr-") as folder:
        path = (Path(folder) if place is None else place) / f".npdr-{uuid4().hex}.xml"
        try:
            path.write_text(text, encoding="utf-8")
            found = load_mjcf(path)
        except ModelError as error:
            raise ModelError(str(error).replace(str(path), "The new text")) from None
        finally:
            path.unlink(missing_ok=True)
    for name in _COMPARED:
        if not hasattr(wanted, name) and not name.startswith("opt."):
            continue  # of a later version of the engine
        one, other = _array(found, name).reshape(-1), _array(wanted, name).reshape(-1)
        if one.shape != other.shape or not np.allclose(one, other, rtol=1e-9, atol=1e-12):
            raise ModelError(
                f"The new file's {name} would differ from the model's, because a setting of the "
                "file replaces it, such as dampratio, inertiafromgeom, springdamper or a <frame>. "
                "Remove that setting, or give other fields as parameters."
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
        self._options: dict[str, tuple[str, str]] = {}  # of a file that has no such element

    def write(self, array: str, places: Sequence[int]) -> None:
        """Writes the numbers of an array at some places.

        Args:
            array: Its name.
            places: Places in the flat array.
        """
        if array.startswith("opt."):
            name = array.removeprefix("opt.")
            old, new = (_words(_array(model, array)) for model in (self.before, self.model))
            self._option(name, new, old)
            return
        width = int(np.prod(_array(self.model, array).shape[1:]))
        if array not in _WRITERS:
            raise ModelError(f"{array} cannot be written into an MJCF file.")
        for row in sorted({place // width for place in places}):
            _WRITERS[array](self, row)

    def keep_damping(self) -> None:
        """Writes the kv of servos for which the file gives a damping ratio, which would set it."""
        for actuator in range(int(self.model.nu)):
            try:
                place = self.element("actuator", actuator)
            except ModelError:  # it has no name, and nothing about it changes
                continue
            if "dampratio" in self.text.tags[place].attributes:
                kv = -float(self.model.actuator_biasprm[actuator, 2])
                self.text.set(place, {"dampratio": None, "kv": _words(kv)})

    def write_options(self, step: float) -> None:
        """Writes the step and the integrator, if they differ from the file's."""
        old = float(self.before.opt.timestep)
        if step != old:
            self._option("timestep", repr(step), repr(old))
        stated = [self.text.tags[i].attributes for i in self.text.sections("option")]
        named = [attributes["integrator"] for attributes in stated if "integrator" in attributes]
        was = (named or ["Euler"])[-1]
        now = _INTEGRATORS[int(self.model.opt.integrator)]
        if now != was:
            self._option("integrator", now, was)

    def _option(self, name: str, value: str, was: str) -> None:
        note = f"npdr: {name} {value} (was {was})"
        sections = self.text.sections("option")
        if sections:
            self.text.set(sections[-1], {name: value}, note)
            return
        self._options[name] = value, note
        words = " ".join(f'{name}="{value}"' for name, (value, _) in self._options.items())
        notes = " ".join(f"<!-- {note} -->" for _, note in self._options.values())
        self.text.insert(0, f"{notes} <option {words}/>")

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
        arrays = {"mass": "body_mass", "pos": "body_ipos", "diaginertia": "body_inertia"}
        both = {n: tuple(getattr(x, a)[body] for x in (self.before, m)) for n, a in arrays.items()}
        note = _note({name: pair for name, pair in both.items() if not np.array_equal(*pair)})
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
        elif tag.name == "velocity" and new_bias[2] == -new[0]:
            self.attribute("actuator", actuator, {"kv": (old[0], new[0])})
        elif tag.name == "general":
            gains = {"gainprm": (old[:3], new[:3]), "biasprm": (old_bias[:3], new_bias[:3])}
            self.attribute("actuator", actuator, gains)
        else:
            raise ModelError(
                f"The gain of a <{tag.name}> actuator cannot be written; make its gear a "
                "parameter instead."
            )

    def _angles_are_degrees(self) -> bool:
        """Returns whether the file's angles are degrees, as they are if it does not say."""
        stated = [
            self.text.tags[i].attributes.get("angle") for i in self.text.sections("compiler")
        ]
        return ([s for s in stated if s] or ["degree"])[-1] == "degree"


_INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
"""Names of the engine's integrators in a file, by number."""


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

        higher = getattr(edits.model, f"dof_{name}poly", None)
        values = {name: _with_higher(*both(name), higher, dof)}
        if name == "frictionloss":
            # As hard as in the package's simulations, where the friction is an effect.
            values |= {"solreffriction": both("solref"), "solimpfriction": both("solimp")}
        edits.attribute("joint", int(edits.model.dof_jntid[dof]), values)

    return write


def _stiffness(edits: _Edits, joint: int) -> None:
    old, new = (model.jnt_stiffness[joint] for model in (edits.before, edits.model))
    higher = getattr(edits.model, "jnt_stiffnesspoly", None)
    edits.attribute("joint", joint, {"stiffness": _with_higher(old, new, higher, joint)})


def _with_higher(old: Any, new: Any, higher: Any, row: int) -> tuple[Any, Any]:
    """Returns both values with the coefficients of higher order, if the file has some."""
    if higher is None or not np.any(higher[row]):
        return old, new
    return np.array([old, *higher[row]]), np.array([new, *higher[row]])


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
        place = edits.element("actuator", actuator)
        edits.text.set(place, {f"{name}limited": "true"})
        if "inheritrange" in edits.text.tags[place].attributes:
            edits.text.set(place, {"inheritrange": None})

    return write


_WRITERS: dict[str, Callable[[_Edits, int], None]] = {
    "dof_damping": _of_dof("damping"),
    "dof_frictionloss": _of_dof("frictionloss"),
    "dof_armature": _of_dof("armature"),
    "jnt_stiffness": _stiffness,
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
