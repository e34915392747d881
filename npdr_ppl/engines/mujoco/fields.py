"""Readable names for the numbers of a MuJoCo model, e.g. ``"body hand mass"``.

They have the form *element name quantity component*, as in ``"geom floor friction sliding"``. The
name may be a pattern (``"geom * friction sliding"``); ``"joint * friction_softness"`` means all
joints with dry friction. Options have no name (``"option gravity"``, the vector's magnitude).
"""

import importlib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from npdr_ppl.errors import ModelError
from npdr_ppl.registry import hint

__all__ = [
    "Entry",
    "Field",
    "actuated_joint",
    "actuator_names",
    "element_names",
    "find_field",
    "follows_its_command",
    "joint_units",
    "servo_gains",
]


class Entry(NamedTuple):
    """One number of a model.

    Attributes:
        array: The array of the ``MjModel`` that contains it, ``"opt.…"`` for options.
        place: Its index in the flat array.
        factor: Change of its value per change of the field's value.
        nominal: Its value in the file.
        offset: Its value where the field is zero.
    """

    array: str
    place: int
    factor: float
    nominal: float
    offset: float = 0.0

    def number(self, value: Any) -> Any:
        """Returns the number that a value of the field stands for."""
        return self.offset + value * self.factor


@dataclass(frozen=True)
class Field:
    """A quantity of a model, one number or several.

    Attributes:
        text: The name with which it was found.
        unit: Its unit.
        entries: The numbers of the model that it sets.
    """

    text: str
    unit: str
    entries: tuple[Entry, ...]

    @property
    def nominal(self) -> float | None:
        """Value of the field in the file; ``None`` if its entries have different values."""
        values = [(e.nominal - e.offset) / e.factor for e in self.entries if e.factor]
        spread = max(values) - min(values)
        return values[0] if spread <= 1e-9 * max(map(abs, values)) else None


class _Quantity(NamedTuple):
    """Where a quantity of an element is stored.

    The unit may refer to a joint's force, position or inertia; see :func:`joint_units`.
    """

    array: str
    unit: str
    components: tuple[str, ...] = ()
    first: int = 0


_XYZ = ("x", "y", "z")
_CONTACT = ("time_constant", "damping_ratio")

_QUANTITIES: dict[str, dict[str, _Quantity]] = {
    "body": {
        "mass": _Quantity("body_mass", "kg"),
        "inertia": _Quantity("body_inertia", "kg m²", _XYZ),
        # The inertia keeps its ratio to the mass, as if only the density changed.
        "mass_and_inertia": _Quantity("body_mass", "kg"),
        "centre": _Quantity("body_ipos", "m", _XYZ),
        "position": _Quantity("body_pos", "m", _XYZ),
        "gravity_compensation": _Quantity("body_gravcomp", "1"),
    },
    "joint": {
        "damping": _Quantity("dof_damping", "{force} s/{position}"),
        "frictionloss": _Quantity("dof_frictionloss", "{force}"),
        # Impedance and time constant; see :func:`_softness_entries`.
        "friction_softness": _Quantity("dof_solimp", "1"),
        "armature": _Quantity("dof_armature", "{inertia}"),
        "stiffness": _Quantity("jnt_stiffness", "{force}/{position}"),
        "rest": _Quantity("qpos_spring", "{position}"),
        "position": _Quantity("jnt_pos", "m", _XYZ),
        "range": _Quantity("jnt_range", "{position}", ("lower", "upper")),
    },
    "geom": {
        "friction": _Quantity("geom_friction", "1", ("sliding", "torsional", "rolling")),
        "size": _Quantity("geom_size", "m", _XYZ),
        "position": _Quantity("geom_pos", "m", _XYZ),
        "contact": _Quantity("geom_solref", "1", _CONTACT),
    },
    "site": {"position": _Quantity("site_pos", "m", _XYZ)},
    "actuator": {
        "gain": _Quantity("actuator_gainprm", "1"),
        "bias": _Quantity("actuator_biasprm", "1", ("constant", "position", "velocity")),
        # Gains of servos; see :func:`_servo_entries`.
        "kp": _Quantity("actuator_gainprm", "{force}/{position}"),
        "kv": _Quantity("actuator_biasprm", "{force} s/{position}"),
        "gear": _Quantity("actuator_gear", "1"),
        "time_constant": _Quantity("actuator_dynprm", "s"),
        "force_range": _Quantity("actuator_forcerange", "1", ("lower", "upper")),
    },
    "tendon": {
        "stiffness": _Quantity("tendon_stiffness", "N/m"),
        "damping": _Quantity("tendon_damping", "N s/m"),
        "frictionloss": _Quantity("tendon_frictionloss", "N"),
        "armature": _Quantity("tendon_armature", "kg"),
    },
    "option": {
        "gravity": _Quantity("opt.gravity", "m/s²", _XYZ),
        "wind": _Quantity("opt.wind", "m/s", _XYZ),
        "density": _Quantity("opt.density", "kg/m³"),
        "viscosity": _Quantity("opt.viscosity", "Pa s"),
    },
}

# Components whose unit differs from the unit of their quantity.
_UNITS = {
    ("geom", "friction", "torsional"): "m",
    ("geom", "friction", "rolling"): "m",
    ("geom", "contact", "time_constant"): "s",
}

# Units of gains of an actuator that acts on several joints, whose forces have no common unit.
_UNKNOWN = {"1/1": "1", "1 s/1": "s"}

_COUNTS = {
    "body": "nbody",
    "joint": "njnt",
    "geom": "ngeom",
    "site": "nsite",
    "actuator": "nu",
    "tendon": "ntendon",
    "sensor": "nsensor",
    "key": "nkey",
}


def element_names(model: Any, kind: str) -> list[str]:
    """Returns names of a model's elements of a kind, ``<kind>_<number>`` for unnamed ones."""
    count = int(getattr(model, _COUNTS[kind]))
    return [getattr(model, kind)(i).name or f"{kind}_{i}" for i in range(count)]


def actuator_names(model: Any) -> list[str]:
    """Returns the names of actuators; unnamed ones are named after their joint."""
    joints, names = element_names(model, "joint"), []
    for actuator, name in enumerate(element_names(model, "actuator")):
        joint = actuated_joint(model, actuator)
        if not model.actuator(actuator).name and joint is not None:
            name = f"{joints[joint]}_command"
        names.append(f"{name}_{actuator}" if name in names else name)
    return names


def joint_units(model: Any, joint: int) -> dict[str, str]:
    """Returns the units of a joint's position, force and inertia."""
    mujoco: Any = importlib.import_module("mujoco")
    kind = int(model.jnt_type[joint])
    if kind == int(mujoco.mjtJoint.mjJNT_SLIDE):
        return {"position": "m", "force": "N", "inertia": "kg"}
    if kind == int(mujoco.mjtJoint.mjJNT_FREE):
        return {"position": "1", "force": "1", "inertia": "1"}
    return {"position": "rad", "force": "N m", "inertia": "kg m²"}


def find_field(model: Any, text: str) -> Field:
    """Returns the field that a name stands for.

    Args:
        model: A ``mujoco.MjModel``.
        text: The name; see the docstring of the module.

    Raises:
        ModelError: The model has no such element or quantity; the message suggests the nearest.
    """
    words = text.split()
    if not words or words[0] not in _QUANTITIES:
        raise ModelError(
            f"A field is called 'element name quantity', e.g. 'body hand mass'; got {text!r}: "
            + hint(words[0] if words else "", _QUANTITIES)
        )
    kind, rest = words[0], words[1:]
    name, quantity, component = _split(kind, rest, text)
    if kind == "option":
        return _option(model, text, quantity, component)
    names = actuator_names(model) if kind == "actuator" else element_names(model, kind)
    chosen = [i for i, n in enumerate(names) if n == name]
    chosen = chosen or [i for i, n in enumerate(names) if fnmatchcase(n, name)]
    if not chosen:
        raise ModelError(f"{text!r}: no {kind} is called {name!r}; {hint(name, names)}")
    info = _QUANTITIES[kind][quantity]
    unit = _UNITS.get((kind, quantity, component), info.unit)
    units = {unit.format(**_joint_units_of(model, kind, i)) for i in chosen}
    units = {_UNKNOWN.get(unit, unit) for unit in units}
    if len(units) > 1:
        raise ModelError(f"{text!r} mixes the units {', '.join(sorted(units))}.")
    read = {
        "kp": _servo_entries,
        "kv": _servo_entries,
        "mass_and_inertia": _solid_entries,
        "friction_softness": _softness_entries,
    }
    if quantity == "friction_softness" and name not in names:
        chosen = [i for i in chosen if model.dof_frictionloss[model.dof_jntid == i].any()]
        if not chosen:
            raise ModelError(f"{text!r}: no such joint has dry friction in the file.")
    if quantity in read:
        entries = [e for i in chosen for e in read[quantity](model, i, quantity, text)]
    else:
        entries = [e for i in chosen for e in _entries(model, kind, i, info, component)]
    return Field(text, units.pop(), tuple(entries))


def actuated_joint(model: Any, actuator: int) -> int | None:
    """Returns the joint that an actuator acts on directly; ``None`` if there is none."""
    mujoco: Any = importlib.import_module("mujoco")
    if int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_JOINT):
        return None
    return int(model.actuator_trnid[actuator, 0])


def servo_gains(model: Any, actuator: int) -> tuple[str, ...]:
    """Returns which gains an actuator has: kp and kv of position servos, kv of velocity servos.

    The command of a position servo can have a unit of its own, such as 0 to 255 for a gripper.
    """
    mujoco: Any = importlib.import_module("mujoco")
    is_fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
    is_affine = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
    gain = float(model.actuator_gainprm[actuator, 0])
    _, position, velocity = map(float, model.actuator_biasprm[actuator, :3])
    if not (is_fixed and is_affine and gain > 0.0):
        return ()
    if position < 0.0:
        return ("kp", "kv") if velocity < 0.0 else ("kp",)
    return ("kv",) if position == 0.0 and velocity == -gain else ()


def follows_its_command(model: Any, actuator: int) -> bool:
    """Returns whether an actuator is a servo whose command has the unit of what it controls."""
    gains = servo_gains(model, actuator)
    gain, position = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, 1]
    return bool(gains) and ("kp" not in gains or float(gain) == -float(position))


def _joint_units_of(model: Any, kind: str, element: int) -> dict[str, str]:
    """Returns the units of the joint that an element is or acts on."""
    joint = element if kind == "joint" else None
    if kind == "actuator":
        joint = actuated_joint(model, element)
    if joint is None:
        return {"position": "1", "force": "1", "inertia": "1"}
    return joint_units(model, joint)


def _servo_entries(model: Any, actuator: int, gain: str, text: str) -> list[Entry]:
    """Returns the numbers that a gain of a servo sets.

    The force of a position servo is kp (s control − position) − kv velocity, so kp sets the gain,
    s times itself, and minus the bias. That of a velocity servo is kv (control − velocity).
    """
    numbers, quantities = [], _QUANTITIES["actuator"]
    for name, component in (("kp", ""), ("bias", "position"), ("bias", "velocity")):
        numbers += _entries(model, "actuator", actuator, quantities[name], component)
    control, position, velocity = numbers
    minus_position, minus_velocity = position._replace(factor=-1.0), velocity._replace(factor=-1.0)
    is_position_servo = control.nominal > 0.0 > position.nominal
    if gain == "kp" and is_position_servo:
        scale = control.nominal / -position.nominal
        return [minus_position, control._replace(factor=scale)]
    if gain == "kv" and is_position_servo:
        return [minus_velocity]
    if gain == "kv" and position.nominal == 0.0 and control.nominal == -velocity.nominal:
        return [control, minus_velocity]
    servos = "position servos" if gain == "kp" else "position and velocity servos"
    raise ModelError(f"{text!r}: only {servos} have a {gain}; bind gain and bias.")


def _solid_entries(model: Any, body: int, quantity: str, text: str) -> list[Entry]:
    """Returns a body's mass and its inertias, which are a constant times the mass."""
    info = _QUANTITIES["body"]
    (mass,) = _entries(model, "body", body, info["mass"], "")
    if mass.nominal == 0.0:
        raise ModelError(f"{text!r}: the body has no mass, so its inertia has no ratio to it.")
    inertias = _entries(model, "body", body, info["inertia"], "")
    return [mass, *(e._replace(factor=e.nominal / mass.nominal) for e in inertias)]


def _softness_entries(model: Any, joint: int, quantity: str, text: str) -> list[Entry]:
    """Returns the numbers that set how far a joint's dry friction yields.

    The engine's friction holds a joint only nearly: under a force f below the friction loss, the
    joint creeps at about T f (1 − d) / (2 d m), where d is the first number of ``solimpfriction``,
    T that of ``solreffriction`` and m the joint's inertia. A joint that stops is slowed during T.
    The softness is 1 − d, and T decreases linearly with it, to two of the file's steps at zero; it
    stays as it is if the file has a shorter one, or a stiffness in its place. The engine allows
    impedances of 0.0001 to 0.9999 and time constants of at least two steps.
    """
    impedances, times = (
        _entries(model, "joint", joint, info, "")
        for info in (_QUANTITIES["joint"][quantity], _Quantity("dof_solref", "s"))
    )
    found = [entry._replace(factor=-1.0, offset=1.0) for entry in impedances]
    least = 2.0 * float(model.opt.timestep)
    for time, impedance in zip(times, impedances, strict=True):
        softness = 1.0 - impedance.nominal
        if softness > 0.0 and time.nominal > least:  # minus a stiffness is negative
            factor = (time.nominal - least) / softness
            found.append(time._replace(factor=factor, offset=least))
    return found


def _split(kind: str, rest: list[str], text: str) -> tuple[str, str, str]:
    """Splits the words after the element into name, quantity and component (empty if none)."""
    quantities = _QUANTITIES[kind]
    for size in (1, 2):
        if len(rest) < size or (len(rest) == size and kind != "option"):
            continue
        tail = rest[len(rest) - size :]
        if tail[0] in quantities:
            name, component = " ".join(rest[: len(rest) - size]), " ".join(tail[1:])
            known = (*quantities[tail[0]].components, *(["magnitude"] * (kind == "option")))
            if component and component not in known:
                raise ModelError(
                    f"{text!r}: {tail[0]} has no component {component!r}; "
                    + hint(component, known)
                )
            return name, tail[0], component
    raise ModelError(
        f"{text!r}: a {kind} has no such quantity; " + hint(rest[-1] if rest else "", quantities)
    )


def _option(model: Any, text: str, quantity: str, component: str) -> Field:
    info = _QUANTITIES["option"][quantity]
    values = np.atleast_1d(getattr(model.opt, info.array.removeprefix("opt.")))
    if component in info.components:
        place = info.components.index(component)
        return Field(text, info.unit, (Entry(info.array, place, 1.0, float(values[place])),))
    if len(values) == 1:
        return Field(text, info.unit, (Entry(info.array, 0, 1.0, float(values[0])),))
    # Sets the magnitude of the vector and keeps its direction.
    size = float(np.linalg.norm(values))
    if size == 0.0:
        raise ModelError(f"{text!r} is zero in the file, so only its components can be set.")
    entries = [Entry(info.array, i, float(v) / size, float(v)) for i, v in enumerate(values)]
    return Field(text, info.unit, tuple(entries))


def _entries(model: Any, kind: str, element: int, info: _Quantity, component: str) -> list[Entry]:
    """Returns the numbers of one element's quantity."""
    array = np.asarray(getattr(model, info.array))
    width = array[0].size if array.ndim > 1 else 1
    rows = [element]
    if info.array.startswith("dof_"):
        rows = np.flatnonzero(model.dof_jntid == element).tolist()
    elif info.array == "qpos_spring":
        rows = [int(model.jnt_qposadr[element])]
    columns = [0]
    if component:
        columns = [info.components.index(component)]
    elif info.components:
        columns = list(range(len(info.components)))
    flat = array.reshape(-1)
    places = [row * width + column for row in rows for column in columns]
    return [Entry(info.array, place, 1.0, float(flat[place])) for place in places]
