"""State components, sensors and actions of a MuJoCo model as channels."""

import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from npdr_ppl.engines.mujoco.fields import (
    actuated_joint,
    actuator_names,
    element_names,
    joint_units,
)
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel, Spin
from npdr_ppl.registry import hint

__all__ = [
    "Component",
    "Reading",
    "Selection",
    "action_channels",
    "choose",
    "mjcf_sensors",
    "spins",
    "state_components",
]

Selection = Sequence[str] | Mapping[str, str] | None
"""Names to keep, or new names mapped to old ones; ``None`` for the default."""


@dataclass(frozen=True)
class Component:
    """One component of the state.

    Attributes:
        channel: Its name and unit, and the channel of which it is the rate.
        address: Its index in MuJoCo's qpos or qvel.
        is_velocity: Whether it is in qvel.
    """

    channel: Channel
    address: int
    is_velocity: bool


@dataclass(frozen=True)
class Reading:
    """One number of an MJCF sensor.

    Attributes:
        channel: Its name and unit.
        address: Its index in MuJoCo's sensordata.
        stage: 1 if it depends on positions, 2 on velocities, 3 on accelerations.
    """

    channel: Channel
    address: int
    stage: int


_XYZ = ("x", "y", "z")


def state_components(model: Any) -> tuple[Component, ...]:
    """Returns every component of qpos, then every component of qvel.

    A hinge or slide called ``elbow`` has ``elbow`` and ``elbow_velocity``. A free joint called
    ``root`` has ``root_x``, ``root_y``, ``root_z`` and the quaternion ``root_qw`` … ``root_qz``,
    with ``root_x_velocity`` … and, about the body's own axes, ``root_x_spin`` …. A ball joint has
    the rotational part only.
    """
    mujoco: Any = importlib.import_module("mujoco")
    positions: list[tuple[str, str]] = []
    velocities: list[tuple[str, str, str | None]] = []
    for joint, name in enumerate(element_names(model, "joint")):
        kind = int(model.jnt_type[joint])
        unit = joint_units(model, joint)["position"]
        if kind in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
            positions.append((name, unit))
            velocities.append((f"{name}_velocity", f"{unit}/s", name))
            continue
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            positions += [(f"{name}_{axis}", "m") for axis in _XYZ]
            velocities += [(f"{name}_{a}_velocity", "m/s", f"{name}_{a}") for a in _XYZ]
        positions += [(f"{name}_q{axis}", "1") for axis in ("w", *_XYZ)]
        velocities += [(f"{name}_{axis}_spin", "rad/s", None) for axis in _XYZ]
    return (
        *(Component(Channel(n, unit), i, False) for i, (n, unit) in enumerate(positions)),
        *(
            Component(Channel(n, unit, rate_of=rate_of), i, True)
            for i, (n, unit, rate_of) in enumerate(velocities)
        ),
    )


def spins(
    model: Any, components: Sequence[Component], states: Sequence[Channel]
) -> tuple[Spin, ...]:
    """Returns the states that are spins of balls and free bodies whose orientation is a state.

    Args:
        model: A ``mujoco.MjModel``.
        components: Where MuJoCo stores each state.
        states: The states.
    """
    mujoco: Any = importlib.import_module("mujoco")
    names = {
        (component.is_velocity, component.address): state.name
        for component, state in zip(components, states, strict=True)
    }
    result = []
    for joint in range(model.njnt):
        is_free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
        if not is_free and int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_BALL):
            continue
        place, rate = (
            int(first[joint]) + (3 if is_free else 0)
            for first in (model.jnt_qposadr, model.jnt_dofadr)
        )
        w, x, y, z = (names.get((False, place + k)) for k in range(4))
        for axis in range(3):
            name = names.get((True, rate + axis))
            if name and w and x and y and z:
                result.append(Spin(name, axis, (w, x, y, z)))
    return tuple(result)


def mjcf_sensors(model: Any) -> tuple[Reading, ...]:
    """Returns every number of every sensor element; vector components end in ``_x`` and so on."""
    result = []
    for sensor, name in enumerate(element_names(model, "sensor")):
        size, first = int(model.sensor_dim[sensor]), int(model.sensor_adr[sensor])
        endings = {1: ("",), 3: ("_x", "_y", "_z"), 4: ("_w", "_x", "_y", "_z")}.get(
            size, tuple(f"_{i}" for i in range(size))
        )
        unit, stage = _sensor_unit(model, sensor), int(model.sensor_needstage[sensor])
        for i, ending in enumerate(endings):
            result.append(Reading(Channel(f"{name}{ending}", unit), first + i, stage))
    return tuple(result)


def choose(
    known: Mapping[str, Component | Reading], selection: Selection, what: str
) -> tuple[Any, ...]:
    """Returns the chosen components or sensors under their new names.

    Args:
        known: Components or sensors by name.
        selection: Names, or new names mapped to old ones; ``None`` for all.
        what: Their kind, for messages.

    Raises:
        ModelError: A name is unknown or chosen twice.
    """
    if selection is None:
        return tuple(known.values())
    pairs = (
        dict(selection) if isinstance(selection, Mapping) else {name: name for name in selection}
    )
    new_names = {old: new for new, old in pairs.items()}
    if len(new_names) < len(selection):
        raise ModelError(f"A {what} is chosen twice: {', '.join(pairs.values())}.")
    result = []
    for new, old in pairs.items():
        if old not in known:
            raise ModelError(f"There is no {what} {old!r}; {hint(old, known)}")
        channel = known[old].channel
        rate_of = channel.rate_of and new_names.get(channel.rate_of)
        result.append(replace(known[old], channel=replace(channel, name=new, rate_of=rate_of)))
    return tuple(result)


def action_channels(model: Any, taken: Sequence[str]) -> tuple[Channel, ...]:
    """Returns a channel per actuator, with the bounds of its control range.

    An actuator is named after its joint, e.g. ``elbow_command``, if it has no name or if a state
    or sensor already has its name.

    Args:
        model: A ``mujoco.MjModel``.
        taken: Names of states and sensors.
    """
    names: list[str] = []
    for actuator, name in enumerate(actuator_names(model)):
        name = f"{name}_command" if name in taken else name
        while name in names or name in taken:
            name = f"{name}_{actuator}"
        names.append(name)
    result = []
    for actuator, name in enumerate(names):
        lower, upper = -math.inf, math.inf
        if model.actuator_ctrllimited[actuator]:
            lower, upper = map(float, model.actuator_ctrlrange[actuator])
        result.append(Channel(name, _action_unit(model, actuator), lower, upper))
    return tuple(result)


def _action_unit(model: Any, actuator: int) -> str:
    """Returns the unit of a control if the file determines it, ``"1"`` otherwise."""
    joint = actuated_joint(model, actuator)
    if joint is None:
        return "1"
    units = joint_units(model, joint)
    gain, bias = float(model.actuator_gainprm[actuator, 0]), model.actuator_biasprm[actuator]
    has_unit_gear = float(model.actuator_gear[actuator, 0]) == 1.0
    if gain != 0.0 and float(bias[1]) == -gain:
        return units["position"] if has_unit_gear else "1"
    if gain != 0.0 and float(bias[2]) == -gain and float(bias[1]) == 0.0:
        return f"{units['position']}/s" if has_unit_gear else "1"
    return units["force"] if gain == 1.0 and has_unit_gear else "1"


# Units of sensors, by the end of the names of MuJoCo's constants.
_SENSOR_UNITS = {
    "ACCELEROMETER": "m/s²",
    "VELOCIMETER": "m/s",
    "GYRO": "rad/s",
    "FORCE": "N",
    "TORQUE": "N m",
    "TOUCH": "N",
    "RANGEFINDER": "m",
    "TENDONPOS": "m",
    "TENDONVEL": "m/s",
    "BALLANGVEL": "rad/s",
    "FRAMEPOS": "m",
    "FRAMELINVEL": "m/s",
    "FRAMEANGVEL": "rad/s",
    "FRAMELINACC": "m/s²",
    "FRAMEANGACC": "rad/s²",
    "SUBTREECOM": "m",
    "SUBTREELINVEL": "m/s",
    "SUBTREEANGMOM": "kg m²/s",
    "E_POTENTIAL": "J",
    "E_KINETIC": "J",
    "CLOCK": "s",
}


def _sensor_unit(model: Any, sensor: int) -> str:
    """Returns the unit of a sensor, ``"1"`` if the file does not determine it."""
    mujoco: Any = importlib.import_module("mujoco")
    kind = mujoco.mjtSensor(int(model.sensor_type[sensor])).name.removeprefix("mjSENS_")
    if kind.startswith("JOINT"):
        units = joint_units(model, int(model.sensor_objid[sensor]))
        rate = "/s" if kind.endswith("VEL") else ""
        return units["force"] if kind.endswith("FRC") else units["position"] + rate
    return _SENSOR_UNITS.get(kind, "1")
