"""Writes laws, with the values that were identified, as one Python file."""

import ast
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from npdr_ppl.engines.mujoco.callbacks import command_laws, joint_laws, runner, sensor_laws
from npdr_ppl.engines.mujoco.callbacks.traced_laws import TracedLaw, trace
from npdr_ppl.engines.mujoco.channels import Reading
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import Effect, ForceEffect, SensorEffect
from npdr_ppl.python_text import plain, quoted

__all__ = [
    "LAWS",
    "CallbackFile",
    "callback_file",
    "effects_class",
    "has_dry_friction",
    "law_of",
    "python_source",
]

LAWS: dict[str, type] = {
    "viscous_friction": joint_laws.ViscousFriction,
    "coulomb_friction": joint_laws.CoulombFriction,
    "asymmetric_coulomb_friction": joint_laws.AsymmetricCoulombFriction,
    "stribeck_friction": joint_laws.StribeckFriction,
    "presliding_friction": joint_laws.PreslidingFriction,
    "quadratic_drag": joint_laws.QuadraticDrag,
    "load_dependent_friction": joint_laws.LoadDependentFriction,
    "friction_drift": joint_laws.FrictionDrift,
    "bias": joint_laws.Bias,
    "cogging": joint_laws.Cogging,
    "spring": joint_laws.Spring,
    "hardening_spring": joint_laws.HardeningSpring,
    "joint_elasticity": joint_laws.JointElasticity,
    "backlash": joint_laws.Backlash,
    "unbalance": joint_laws.Unbalance,
    "wind": joint_laws.Wind,
    "periodic_disturbance": joint_laws.PeriodicDisturbance,
    "input_delay": command_laws.InputDelay,
    "actuator_lag": command_laws.ActuatorLag,
    "actuator_gain": command_laws.ActuatorGain,
    "supply_sag": command_laws.SupplySag,
    "saturation": command_laws.Saturation,
    "dead_zone": command_laws.DeadZone,
    "goal_speed_limit": command_laws.GoalSpeedLimit,
    "goal_acceleration_limit": command_laws.GoalAccelerationLimit,
    "goal_resolution": command_laws.GoalResolution,
    "servo_integral_action": command_laws.IntegralAction,
    "servo_dead_band": command_laws.ServoDeadBand,
    "encoder_bias": sensor_laws.EncoderBias,
    "encoder_scale": sensor_laws.EncoderScale,
    "quantisation": sensor_laws.Quantisation,
    "sensor_low_pass": sensor_laws.SensorLowPass,
    "sensor_delay": sensor_laws.SensorDelay,
    "clock_skew": sensor_laws.ClockSkew,
}
"""The law of each effect that can be exported as Python, by the effect's id."""

_SOURCES = ("joint_laws.py", "command_laws.py", "sensor_laws.py", "runner.py", "randomised_env.py")
"""Modules of this folder, in the order in which their classes are copied."""


@dataclass(frozen=True)
class CallbackFile:
    """A Python file with laws.

    Attributes:
        text: Its text.
        effects: Names of the effects in it.
    """

    text: str
    effects: tuple[str, ...]


def law_of(effect: Effect) -> type | TracedLaw:
    """Returns the class of an effect's law, or what writes it.

    Args:
        effect: An effect of the catalogue, of a user's file, or with a learned law.

    Raises:
        ModelError: There is no Python for it; the message says why, without a full stop.
    """
    own = LAWS.get(effect.id)
    if type(effect).__module__.partition(".")[0] == __name__.partition(".")[0]:
        if own is None:
            raise ModelError("npdr export has no Python for this law")
        return own
    try:
        return trace(effect)
    except ModelError:
        # ``revised_model.py`` holds copies of the catalogue's effects, as delays, that only Python
        # of our own can express.
        if own is None or {p.name for p in effect.parameters} - set(own.__dataclass_fields__):
            raise
        return own


def has_dry_friction(effect: Effect) -> bool:
    """Returns whether an effect's law has a bound of dry friction."""
    try:
        law = law_of(effect)
    except ModelError:
        return False
    if isinstance(law, TracedLaw):
        return law.has_dry_friction
    own = getattr(law, "dry_friction", None)
    return own is not None and own is not joint_laws.JointLaw.dry_friction


def _class_names(effects: Sequence[Effect]) -> dict[str, str]:
    """Returns the name of each effect's class in the file, by the effect's name.

    Effects share a class if their laws are the same. Other classes of one name get numbers.
    """
    texts = {name: "" for name in (*_pieces(), *_WRITTEN)}  # no law may replace one of ours
    result: dict[str, str] = {}
    for effect in effects:
        law = law_of(effect)
        if isinstance(law, TracedLaw):
            names = (f"{law.name}{number or ''}" for number in (0, *range(2, 2 + len(texts))))
            name = next(n for n in names if texts.get(n, law.text) == law.text)
            texts[name] = law.text
        else:
            name = law.__name__
        result[effect.name] = name
    return result


def _law_lines(simulator: MujocoMechanism, effects: Sequence[Effect]) -> list[str]:
    """Returns an expression that makes the law of each effect at each of its places.

    Args:
        simulator: The simulator.
        effects: Effects with a law.
    """
    lines = []
    names = _class_names(effects)
    for effect in effects:
        is_traced = isinstance(law_of(effect), TracedLaw)
        # A law that was written in torch may divide by a parameter that is zero.
        value = "np.float64(values[{}])" if is_traced else "values[{}]"
        given = [f"{p.name}={value.format(quoted(s))}," for p, s in _parameters(effect)]
        if not is_traced:
            given += [f"{name}={value!r}," for name, value in effect.constants.items()]
        for place in _places(simulator, effect):
            where = quoted(place) if not isinstance(place, tuple) else _pair(*place)
            inside = "\n    ".join([f"{where},", *given])
            lines.append(f"{names[effect.name]}(\n    {inside}\n)")
    return lines


def callback_file(
    simulator: MujocoMechanism,
    effects: Sequence[Effect],
    values: Mapping[str, float],
    *,
    module: str,
    robot: str,
    substeps: int,
) -> CallbackFile:
    """Returns the Python file of some effects.

    Args:
        simulator: The simulator with its channels.
        effects: The effects, in the order of attachment.
        values: Values of their parameters, by site.
        module: Name of the file without its ending.
        robot: Name of the robot's file that is to be loaded.
        substeps: Engine steps per control step.
    """
    code, imports = python_source(runner.LawRunner.__name__, effects)
    table = [_HEAD.format(robot=plain(robot), module=module, substeps=substeps)]
    table += [*imports, "", "import mujoco", "import numpy as np", "", "", code]
    table += ["VALUES = {"]
    for effect in effects:
        units = effect.units(simulator.port(effect.port))
        for parameter, site in _parameters(effect):
            unit = units[parameter.name]
            note = f"{parameter.description}" + (f", {unit}" if unit != "1" else "")
            table.append(f"    {quoted(site)}: {float(values[site])!r},  # {plain(note)}")
    table += ["}", '"""Identified values of the effects."""', ""]
    table += [effects_class(simulator, effects, substeps=substeps, default="VALUES")]
    return CallbackFile("\n".join(table), tuple(effect.name for effect in effects))


def python_source(root: str, effects: Sequence[Effect]) -> tuple[str, list[str]]:
    """Returns the source of a class of this folder and of laws, and the imports they need.

    Args:
        root: Name of the class.
        effects: Effects with a law. With effects, the source has what takes the steps.
    """
    wanted = {root, *([runner.LawRunner.__name__] if effects else [])}
    written: dict[str, str] = {}
    for effect in effects:
        law, name = law_of(effect), _class_names(effects)[effect.name]
        if isinstance(law, TracedLaw):
            wanted.add(law.base)
            written[name] = f"@dataclass\nclass {name}({law.base}):\n{law.text}\n"
        else:
            wanted.add(name)
    code = _code(wanted)
    if written:
        code = "\n\n\n".join([code.rstrip("\n"), *(t.rstrip("\n") for t in written.values())])
        code += "\n\n\n"
    return code, _imports(code)


def effects_class(
    simulator: MujocoMechanism, effects: Sequence[Effect], *, substeps: int, default: str = ""
) -> str:
    """Returns the class ``Effects``, which makes the laws of effects from their values.

    Args:
        simulator: The simulator with its channels.
        effects: The effects.
        substeps: Engine steps per control step.
        default: Name of the values that act where none are given; none if empty.
    """
    lines = ["CHANNELS: dict[str, Channel] = {"]
    for name, (array, element, component) in channels_of(simulator).items():
        lines.append(f'    {quoted(name)}: ("{array}", {quoted(element)}, {component}),')
    lines += ["}", '"""Where each measurement is in the model."""', "", ""]
    laws = ",\n".join(textwrap.indent(e, 8 * " ") for e in _law_lines(simulator, effects))
    template = _CLASS_WITH_VALUES if default else _CLASS
    lines += [template.format(laws=laws, substeps=substeps, default=default)]
    return "\n".join(lines)


def channels_of(simulator: MujocoMechanism) -> dict[str, runner.Channel]:
    """Returns where each measurement of a simulator is; see :data:`runner.Channel`."""
    model: Any = simulator.model
    result: dict[str, runner.Channel] = {}
    for sensor in simulator.readings:
        name = sensor.channel.name
        if isinstance(sensor, Reading):
            array, kind, first = "sensordata", "sensor", model.sensor_adr
        elif sensor.is_velocity:
            array, kind, first = "qvel", "joint", model.jnt_dofadr
        else:
            array, kind, first = "qpos", "joint", model.jnt_qposadr
        number = max(i for i, place in enumerate(first) if int(place) <= sensor.address)
        element = getattr(model, kind)(number).name or number
        result[name] = array, element, sensor.address - int(first[number])
    return result


def _parameters(effect: Effect) -> list[tuple[Any, str]]:
    return list(zip(effect.parameters, effect.parameter_names, strict=True))


def _pair(joint: str | int, number: int) -> str:
    """Returns a joint and the number of its degree of freedom as Python."""
    return f"({quoted(joint)}, {number})"


def _places(simulator: MujocoMechanism, effect: Effect) -> list[joint_laws.JointPlace]:
    """Returns the joints, actuators or channels at which an effect acts, by name."""
    model: Any = simulator.model
    if isinstance(effect, ForceEffect):
        (port,) = (p for p in simulator.force_ports if p.port.name == effect.port)
        joint = model.joint(port.joint).name or port.joint
        if port.position is None:
            return [(joint, port.velocity - int(model.jnt_dofadr[port.joint]))]
        return [joint]
    if isinstance(effect, SensorEffect):
        if simulator.port(effect.port).kind == "clock":
            return [sensor.name for sensor in simulator.sensors]
        return list(effect.channels)
    names = [action.name for action in simulator.actions]
    numbers = [names.index(name) for name in effect.channels]
    return [model.actuator(number).name or number for number in numbers]


@cache
def _pieces() -> dict[str, tuple[str, set[str]]]:
    """Returns the source of each class of this folder, and the names that it uses."""
    pieces: dict[str, tuple[str, set[str]]] = {}
    for module in _SOURCES:
        source = Path(__file__).with_name(module).read_text(encoding="utf-8")
        lines = source.splitlines()
        body = ast.parse(source).body
        for node, after in zip(body, [*body[1:], None], strict=True):
            name = _defined(node)
            if name is None or name == "__all__":
                continue
            decorators = getattr(node, "decorator_list", [])
            first = min([node.lineno, *(d.lineno for d in decorators)])
            # The string behind a constant is its docstring.
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            last = after if is_text and after is not None else node
            text = "\n".join(lines[first - 1 : last.end_lineno])
            used = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} - {name}
            pieces[name] = text, used
    return pieces


def _code(wanted: set[str]) -> str:
    """Returns the source of some classes, and of everything that they use, in order."""
    pieces, kept = _pieces(), set(wanted)
    while more := {u for name in kept for u in pieces[name][1] if u in pieces} - kept:
        kept |= more
    return "\n\n\n".join(text for name, (text, _) in pieces.items() if name in kept) + "\n\n"


def _imports(code: str) -> list[str]:
    """Returns the imports that some code needs."""
    known = {node.id for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Name)}
    result = []
    for module, *names in _IMPORTS:
        used = [name for name in names if name in known]
        if used:
            result.append(f"from {module} import {', '.join(used)}")
        elif not names and module in known:
            result.append(f"import {module}")
    return result


def _defined(node: ast.stmt) -> str | None:
    """Returns the name that a statement of a module defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return node.name
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    return None


_HEAD = '''"""Effects that npdr_ppl identified, for {robot}. Needs only mujoco and numpy.

MuJoCo does not have these effects itself. The values are those of VALUES below.

    import mujoco
    from {module} import Effects

    model = mujoco.MjModel.from_xml_path("{robot}")
    data = mujoco.MjData(model)
    effects = Effects(model)
    measured = effects.reset(data)
    for _ in range(1000):
        measured = effects.step(data, commands)  # {substeps} engine steps; measurements by name

In a Gymnasium environment of MuJoCo, let the effects take the steps; call effects.reset(data)
after each reset of the environment:

    robot = env.unwrapped
    robot._step_mujoco_simulation = lambda ctrl, count: effects.step(robot.data, ctrl, count)
"""
'''

_IMPORTS = (
    ("math",),
    ("collections", "deque"),
    ("collections.abc", "Callable", "Mapping", "Sequence"),
    ("dataclasses", "dataclass", "field"),
    ("pathlib", "Path"),
    ("typing", "Any", "ClassVar"),
)
"""Modules of the standard library, and what the laws use of them."""

_WRITTEN = {"CHANNELS", "Effects", "VALUES", "laws", "mujoco", "np"} | {
    name for module, *names in _IMPORTS for name in (module, *names)
}
"""Other names in the file."""

_LAWS = '''

def laws(values: Mapping[str, float]) -> list[Any]:
    """Returns the laws in the order in which they act."""
    return [
{laws},
    ]
'''

_CLASS_WITH_VALUES = (
    '''class Effects(LawRunner):
    """The identified effects.

    Args:
        model: The ``mujoco.MjModel``.
        values: Values that replace those of {default}, by name.
    """

    def __init__(self, model: Any, values: Mapping[str, float] | None = None) -> None:
        chosen = {{**{default}, **(values or {{}})}}
        super().__init__(model, laws(chosen), CHANNELS, {substeps})
'''
    + _LAWS
)

_CLASS = (
    '''class Effects(LawRunner):
    """The identified effects.

    Args:
        model: The ``mujoco.MjModel``.
        values: Values of their parameters, by name.
    """

    def __init__(self, model: Any, values: Mapping[str, float]) -> None:
        super().__init__(model, laws(values), CHANNELS, {substeps})
'''
    + _LAWS
)
