"""Numbers of a MuJoCo model as attributes of elements in an MJCF file's text."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.mjcf_text import MjcfText
from npdr_ppl.errors import ModelError

__all__ = ["Edits", "array_of"]

Array = NDArray[np.float64]


def array_of(model: Any, name: str) -> Array:
    """Returns an array of a model by its name, ``"opt.…"`` for options."""
    if name.startswith("opt."):
        return np.atleast_1d(getattr(model.opt, name.removeprefix("opt.")))
    return np.asarray(getattr(model, name))


class Edits:
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
        self._done: set[tuple[Callable[[Edits, int], None], int]] = set()

    def write(self, array: str, places: Sequence[int]) -> None:
        """Writes the numbers of an array at some places.

        Args:
            array: Its name.
            places: Places in the flat array.
        """
        if array.startswith("opt."):
            name = array.removeprefix("opt.")
            old, new = (_words(array_of(model, array)) for model in (self.before, self.model))
            self._option(name, new, old)
            return
        width = int(np.prod(array_of(self.model, array).shape[1:]))
        if array not in _WRITERS:
            raise ModelError(f"{array} cannot be written into an MJCF file.")
        writer = _WRITERS[array]
        for row in sorted({place // width for place in places}):
            if (writer, row) not in self._done:  # several arrays may have the same writer
                writer(self, row)
                self._done.add((writer, row))

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


_IMPEDANCES = 0.0001, 0.9999
"""Least and greatest impedance; the engine replaces others by these."""


def _of_dof(name: str) -> Callable[[Edits, int], None]:
    def write(edits: Edits, dof: int) -> None:
        def both(array: str) -> tuple[Any, Any]:
            return tuple(getattr(m, f"dof_{array}")[dof] for m in (edits.before, edits.model))

        higher = getattr(edits.model, f"dof_{name}poly", None)
        values = {name: _with_higher(*both(name), higher, dof)}
        if name == "frictionloss":
            # The solver's settings of dry friction are those of the package's simulations.
            old, new = both("solimp")
            new = np.array([np.clip(new[0], *_IMPEDANCES), *new[1:]])
            values |= {"solreffriction": both("solref"), "solimpfriction": (old, new)}
        edits.attribute("joint", int(edits.model.dof_jntid[dof]), values)

    return write


def _stiffness(edits: Edits, joint: int) -> None:
    old, new = (model.jnt_stiffness[joint] for model in (edits.before, edits.model))
    higher = getattr(edits.model, "jnt_stiffnesspoly", None)
    edits.attribute("joint", joint, {"stiffness": _with_higher(old, new, higher, joint)})


def _with_higher(old: Any, new: Any, higher: Any, row: int) -> tuple[Any, Any]:
    """Returns both values with the coefficients of higher order, if the file has some."""
    if higher is None or not np.any(higher[row]):
        return old, new
    return np.array([old, *higher[row]]), np.array([new, *higher[row]])


def _of(kind: str, array: str, name: str) -> Callable[[Edits, int], None]:
    def write(edits: Edits, number: int) -> None:
        old, new = (getattr(model, array)[number] for model in (edits.before, edits.model))
        edits.attribute(kind, number, {name: (old, new)})

    return write


def _rest(edits: Edits, place: int) -> None:
    (joint,) = map(int, np.flatnonzero(np.asarray(edits.model.jnt_qposadr) == place))
    old, new = (edits.angle(joint, m.qpos_spring[place]) for m in (edits.before, edits.model))
    edits.attribute("joint", joint, {"springref": (old, new)})


def _range(edits: Edits, joint: int) -> None:
    old, new = (edits.angle(joint, m.jnt_range[joint]) for m in (edits.before, edits.model))
    edits.attribute("joint", joint, {"range": (old, new)})


def _limits(array: str, name: str) -> Callable[[Edits, int], None]:
    def write(edits: Edits, actuator: int) -> None:
        old, new = (getattr(model, array)[actuator] for model in (edits.before, edits.model))
        edits.attribute("actuator", actuator, {f"{name}range": (old, new)})
        place = edits.element("actuator", actuator)
        edits.text.set(place, {f"{name}limited": "true"})
        if "inheritrange" in edits.text.tags[place].attributes:
            edits.text.set(place, {"inheritrange": None})

    return write


_dry_friction = _of_dof("frictionloss")

_WRITERS: dict[str, Callable[[Edits, int], None]] = {
    "dof_damping": _of_dof("damping"),
    "dof_frictionloss": _dry_friction,
    "dof_solimp": _dry_friction,
    "dof_solref": _dry_friction,
    "dof_armature": _of_dof("armature"),
    "jnt_stiffness": _stiffness,
    "jnt_pos": _of("joint", "jnt_pos", "pos"),
    "jnt_range": _range,
    "qpos_spring": _rest,
    "body_mass": Edits.inertial,
    "body_inertia": Edits.inertial,
    "body_ipos": Edits.inertial,
    "body_iquat": Edits.inertial,
    "body_pos": _of("body", "body_pos", "pos"),
    "body_gravcomp": _of("body", "body_gravcomp", "gravcomp"),
    "geom_friction": _of("geom", "geom_friction", "friction"),
    "geom_size": _of("geom", "geom_size", "size"),
    "geom_pos": _of("geom", "geom_pos", "pos"),
    "geom_solref": _of("geom", "geom_solref", "solref"),
    "site_pos": _of("site", "site_pos", "pos"),
    "actuator_gainprm": Edits.gains,
    "actuator_biasprm": Edits.gains,
    "actuator_gear": _of("actuator", "actuator_gear", "gear"),
    "actuator_forcerange": _limits("actuator_forcerange", "force"),
    "actuator_ctrlrange": _limits("actuator_ctrlrange", "ctrl"),
    "tendon_stiffness": _of("tendon", "tendon_stiffness", "stiffness"),
    "tendon_damping": _of("tendon", "tendon_damping", "damping"),
    "tendon_frictionloss": _of("tendon", "tendon_frictionloss", "frictionloss"),
    "tendon_armature": _of("tendon", "tendon_armature", "armature"),
}
"""What writes a row of each array of a model."""
