"""A Pyro model from an MJCF file alone: which numbers are uncertain, and how much.

The model is Python text, so that what runs is what a user can print and edit.
"""

import copy
import importlib
import math
import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from npdr_ppl.engines.common.robot_files import is_urdf, read_robot
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.batches import quiet
from npdr_ppl.engines.mujoco.dependent_fields import dependent_fields
from npdr_ppl.engines.mujoco.fields import (
    Field,
    actuator_names,
    element_names,
    find_field,
    servo_gains,
)
from npdr_ppl.errors import ModelError

__all__ = ["DerivedModel", "DerivedParameter", "derive_model"]

MASS_RANGE = (0.7, 1.3)
"""Prior of a mass and its inertia, as factors on the file's values. Masses from CAD differ by
cables, screws and paint."""

ARMATURE_RANGE = (0.5, 1.5)
"""Prior of an armature as factors on the file's value. It is the rotor's inertia times the gear
ratio squared, and both are in data sheets."""

GAIN_SPREAD = 1.5
"""Standard deviation of the logarithm of a servo's kp and kv about the file's values: 95 % of the
prior are within a factor of 19. These gains are often tuned until a simulation looks right, not
measured: the kp of 998 N m/rad in the file of the SO-101 is 93 times that of its wrist, and 3
standard deviations away."""

FRICTION_RANGE = (0.0, 10.0)
"""Prior of joint damping and friction loss as factors on the file's values. Both are rarely
measured. Dry friction of four joints of the SO-101 is 2 to 8 times that of its file."""

SOFTNESS_RANGE = (0.0001, 0.1)
"""95 % of the prior of the softness of dry friction, from the hardest that MuJoCo allows to its
default. With the default, a stuck joint creeps: one of 0.03 kg m² that holds 0.15 N m moves 5 mrad
in a second. Real joints hold, but recordings made with the default should be likely, too."""

DEFAULT_SOFTNESS = 0.1
"""Softness of dry friction if a file sets no ``solimpfriction``."""

ROTOR_RANGE = (0.0, 10.0)
"""Prior of an armature of a URDF file, which cannot state any, as factors on a typical value: the
inertia about the joint, or effort / ``ROTOR_ACCELERATION`` if that is larger, as in a wrist. Where
an effort is a placeholder, the largest inertia about any joint limits this."""

ROTOR_ACCELERATION = 500.0
"""Usual acceleration in rad/s² of a geared motor without load, behind the gear: 50 N m move a
rotor of 0.1 kg m² there."""

LEAST_SHARE = 0.001
"""A body lighter than this share of what its joint carries keeps its mass: at most 0.03 % of the
joint's load would change. Such bodies are placeholders in the file."""

_TEMPLATE = '''"""Model of a robot, derived from its file."""

{imports}import pyro
import pyro.distributions as dist

import npdr_ppl as npdr

# What each parameter sets in the file. The inertia of a body changes with its mass.
PARAMETERS = {{
{parameters}
}}

# A parameter that is not listed here keeps the file's value.
PRIORS = {{
{priors}
}}
{held}
robot = npdr.MujocoSimulator({path}, PARAMETERS{also})


def model(inputs):
    parameters = {{name: pyro.sample(name, prior) for name, prior in PRIORS.items()}}
    return npdr.simulate("trajectory", robot, parameters, inputs)
'''


@dataclass(frozen=True)
class DerivedParameter:
    """An uncertain number of the file.

    Attributes:
        name: Name of the parameter, a Python identifier.
        field: What it sets, e.g. ``"joint elbow damping"``.
        unit: Its unit.
        nominal: Its value in the file.
        low: Smallest value of a uniform prior, or the 2.5 % quantile of a log-normal one.
        high: Largest value of a uniform prior, or the 97.5 % quantile of a log-normal one.
        family: Family of the prior. The median of a log-normal one is the geometric mean of its
            quantiles.
    """

    name: str
    field: str
    unit: str
    nominal: float
    low: float
    high: float
    family: Literal["uniform", "log-normal"] = "uniform"

    @property
    def prior(self) -> str:
        """The prior as Python."""
        if self.family == "log-normal":
            median = math.sqrt(self.low * self.high)
            spread = 0.5 * math.log(self.high / self.low) / _QUANTILE
            return f"dist.LogNormal(math.log({median:.4g}), {spread:.4g})"
        return f"dist.Uniform({self.low:.4g}, {self.high:.4g})"


@dataclass(frozen=True)
class DerivedModel:
    """What a model of an MJCF file treats as uncertain.

    Attributes:
        title: Name of the file.
        parameters: The uncertain numbers.
        held: Fields that keep the file's value because positions do not determine them, each with
            the other fields that have the same effect together.
    """

    title: str
    parameters: tuple[DerivedParameter, ...]
    held: dict[str, tuple[str, ...]]

    def reason(self, field: str) -> str:
        """Returns in words why a field keeps the file's value."""
        first, *others = self.held[field] or ("",)
        if not first:
            return "no effect on the motion"
        if not others:
            return f"same effect as {first}"
        return f"same effect as {first} and {len(others)} more together"

    def source(self, path: str | PathLike[str]) -> str:
        """Returns a Python file that defines the function ``model``.

        Args:
            path: The robot's file, as the Python file should name it.
        """
        parameters = [f'    "{p.name}": {_quoted(p.field)},' for p in self.parameters]
        priors = [
            f'    "{p.name}": {p.prior},  # file: {p.nominal:.4g} {p.unit}'
            for p in self.parameters
        ]
        held = [f"    {_quoted(field)}: {_quoted(self.reason(field))}," for field in self.held]
        if held:
            title = "# Not varied, because positions do not determine them beside the parameters."
            held = ["", title, "HELD = {", *held, "}"]
        has_logarithms = any(p.family == "log-normal" for p in self.parameters)
        return _TEMPLATE.format(
            imports="import math\n\n" if has_logarithms else "",
            parameters="\n".join(parameters),
            priors="\n".join(priors),
            held="\n".join([*held, ""]),
            path=_quoted(str(path)),
            also=", held=HELD" if held else "",
        )


def derive_model(source: str | PathLike[str]) -> DerivedModel:
    """Chooses the uncertain numbers of an MJCF file, or of a URDF file that MuJoCo compiles.

    These are

    * the masses of the bodies that joints move, with their inertias,
    * damping, armature and friction loss of joints, where the file has positive values; of a URDF
      file, which cannot state armatures, those of all joints,
    * how far friction loss yields, one number for all joints, if the file keeps the engine's
      default,
    * kp and kv of position and velocity servos.

    Priors of gains are log-normal about the file's values, and that of how far friction loss
    yields is log-normal in ``SOFTNESS_RANGE``. The others are uniform, around the file's values or
    from zero. What positions do not determine beside the others keeps the file's value; see
    :func:`~npdr_ppl.engines.mujoco.dependent_fields.dependent_fields`.

    Args:
        source: Path of the file.

    Raises:
        ModelError: The file is neither MJCF nor URDF, or nothing in it moves.
    """
    with quiet():  # MujocoSimulator logs the engine's warnings
        model = load_mjcf(source)
    title = Path(source).name
    if model.nv == 0:
        raise ModelError(f"{title} has no joints, so nothing in it moves.")
    if model.na:
        raise ModelError(
            f"{title} has actuators with states of their own, such as filters, which recordings "
            "do not contain; remove them, e.g. timeconst, and let npdr discover find a lag."
        )
    has_rotors = not is_urdf(read_robot(source))
    typical = model if has_rotors else _with_rotors(model)
    armature = ARMATURE_RANGE if has_rotors else ROTOR_RANGE
    chosen: dict[str, tuple[Field, str, tuple[float, float] | None]] = {}
    for kind, name, quantity, ends in [
        *_masses(typical),
        *_joints(typical, armature),
        *_servos(typical),
    ]:
        field = find_field(typical, f"{kind} {name} {quantity}")
        if field.nominal is not None and field.nominal > 0.0:
            chosen[field.text] = field, f"{name}_{quantity}".removesuffix("_and_inertia"), ends
    order = sorted((f for f, *_ in chosen.values()), key=_preference)
    with quiet():
        held = dependent_fields(typical, order) if order else {}
    found: list[DerivedParameter] = []
    for text, (field, name, ends) in chosen.items():
        if text not in held:
            own, value = _identifier(name, [p.name for p in found]), field.nominal or 0.0
            in_file = find_field(model, text).nominal or 0.0
            low, high = ends or (1.0 / _FACTOR, _FACTOR)
            family = "log-normal" if ends is None else "uniform"
            found.append(
                DerivedParameter(own, text, field.unit, in_file, low * value, high * value, family)
            )
    found += _softness(model, {parameter.field for parameter in found})
    if not found:
        raise ModelError(f"{title} has no masses, friction or gains that its motion depends on.")
    return DerivedModel(title, tuple(found), held)


_Choice = tuple[str, str, str, tuple[float, float] | None]
"""Kind and name of an element, a quantity of it, and ends of its uniform prior as factors on the
file's value; ``None`` for a log-normal prior about it."""

_QUANTILE = 1.96
"""The 97.5 % quantile of a standard normal distribution."""

_FACTOR = math.exp(_QUANTILE * GAIN_SPREAD)
"""The factor that 95 % of a log-normal prior are within."""


def _with_rotors(model: Any) -> Any:
    """Returns a copy with a typical armature of each hinge and slide; see ``ROTOR_RANGE``."""
    mujoco: Any = importlib.import_module("mujoco")
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    result, kinds = copy.copy(model), model.jnt_type.tolist()
    places = model.jnt_dofadr.tolist()
    inertias = [float(model.dof_M0[p]) for p, k in zip(places, kinds, strict=True) if k == hinge]
    for joint, (kind, place) in enumerate(zip(kinds, places, strict=True)):
        if kind not in (hinge, slide):
            continue
        typical = float(model.dof_M0[place])
        if kind == hinge and model.jnt_actfrclimited[joint]:
            rotor = float(model.jnt_actfrcrange[joint, 1]) / ROTOR_ACCELERATION
            typical = max(typical, min(rotor, max(inertias)))
        result.dof_armature[place] = typical
    return result


def _masses(model: Any) -> list[_Choice]:
    chosen = []
    for body, name in enumerate(element_names(model, "body")):
        carried = float(model.body_subtreemass[model.body_weldid[body]])
        is_moved = model.body_weldid[body] != 0
        if is_moved and float(model.body_mass[body]) > LEAST_SHARE * carried:
            chosen.append(("body", name, "mass_and_inertia", MASS_RANGE))
    return chosen


def _joints(model: Any, armature: tuple[float, float]) -> list[_Choice]:
    ranges = {
        "damping": FRICTION_RANGE,
        "frictionloss": FRICTION_RANGE,
        "armature": armature,
    }
    names = element_names(model, "joint")
    return [("joint", name, word, ends) for word, ends in ranges.items() for name in names]


def _softness(model: Any, varied: set[str]) -> list[DerivedParameter]:
    """Returns how far dry friction yields, if some is varied and the file keeps the default."""
    if not any(text.endswith(" frictionloss") for text in varied):
        return []
    field = find_field(model, "joint * friction_softness")
    if field.nominal is None or not math.isclose(field.nominal, DEFAULT_SOFTNESS):
        return []
    low, high = SOFTNESS_RANGE
    return [
        DerivedParameter(
            "friction_softness", field.text, field.unit, DEFAULT_SOFTNESS, low, high, "log-normal"
        )
    ]


def _servos(model: Any) -> list[_Choice]:
    names = actuator_names(model)
    return [
        ("actuator", name, word, None)
        for word in ("kp", "kv")
        for actuator, name in enumerate(names)
        if word in servo_gains(model, actuator)
    ]


def _preference(field: Field) -> tuple[int, float]:
    """Returns a key that puts first what a recording should determine.

    These are gains and damping, larger ones first, then dry friction and armatures, then masses,
    lighter ones first.
    """
    value = field.nominal or 0.0
    if field.text.startswith("body "):
        return 2, value
    return int(field.text.endswith((" frictionloss", " armature"))), -value


def _quoted(text: str) -> str:
    """Returns a text as a Python string in one line, whatever the names in a file are."""
    written = repr(text)
    return f'"{written[1:-1]}"' if '"' not in text and "'" not in text else written


def _identifier(text: str, taken: list[str]) -> str:
    """Returns a text as an identifier that is not taken yet."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    name = f"_{name}" if name[0].isdigit() else name
    number, base = 1, name
    while name in taken:
        number += 1
        name = f"{base}_{number}"
    return name
