"""Ports of a MuJoCo model; their ratings follow from its actuators, masses and ranges."""

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.channels import Component, Reading
from npdr_ppl.engines.mujoco.fields import actuated_joint, element_names, joint_units
from npdr_ppl.engines.mujoco.servos import is_servo
from npdr_ppl.language.channels import Channel, Port

__all__ = [
    "TO_QUATERNION",
    "ForcePort",
    "actuator_moments",
    "body_axis",
    "derive_ports",
    "driven_dofs",
    "force_ports",
]

Array = NDArray[np.float64]

# A servo's error in a fast motion, as a share of the joint's rated excursion.
_LARGE_ERROR = 0.05

TO_QUATERNION = 3
"""Of a free joint's positions, the number of those before its orientation."""

_NUM_POSES = 32
"""Random poses over which inertias are averaged. On the seven-joint arm of
``benchmarks/servo_arms.py``, their mean differs by at most a fifth from that of 2000 poses."""


@dataclass(frozen=True)
class ForcePort:
    """A hinge, a slide or an axis of a floating body, on which forces of effects act.

    Attributes:
        port: The port with its ratings.
        joint: Number of the joint.
        position: Its index in qpos; ``None`` for an axis of a floating body.
        velocity: Its index in qvel; for an axis with a number, that of the world's axis.
        axis: Number of the body's axis along which the force acts, for forces on a floating body.
            The engine has their velocities in the world's frame.
    """

    port: Port
    joint: int
    position: int | None
    velocity: int
    axis: int | None = None

    @property
    def in_world(self) -> slice:
        """Indices in qvel of the velocity in the world's frame, for an axis with a number."""
        first = self.velocity - (self.axis or 0)
        return slice(first, first + 3)


def force_ports(model: Any, taken: Sequence[str]) -> tuple[ForcePort, ...]:
    """Returns the force ports of all joints.

    Hinges and slides have one, floating bodies one per axis; see :func:`_floating_ports`.

    A port has the name of its joint, or ``<joint>_torque`` (``_force`` for slides) if a channel
    has that name. The rated force is the greatest force of the actuators at the joint; where the
    file does not tell it, it is the weight that the joint carries in the file's pose. The rated
    speed is the speed that the rated force would give the joint over a radian (half the range, or
    a metre), or less if damping limits it. The inertia is the mean of random poses: an arm that
    points upwards in the file has almost none about its vertical axis. A joint is driven if an
    actuator moves it in the file's pose, also through tendons and sites.

    Args:
        model: A ``mujoco.MjModel``.
        taken: Names of channels.
    """
    mujoco: Any = importlib.import_module("mujoco")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertias = _mean_inertias(model)
    actuated, driven = _actuator_ratings(model), driven_dofs(model)
    result = []
    for joint, name in enumerate(element_names(model, "joint")):
        is_slide = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        if not is_slide and int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_HINGE):
            known = [*element_names(model, "joint"), *(p.port.name for p in result)]
            result += _floating_ports(model, joint, name, inertias, [*taken, *known])
            continue
        dof = int(model.jnt_dofadr[joint])
        inertia, damping = float(inertias[dof]), float(model.dof_damping[dof])
        rated = actuated.get(joint) or _weight(model, data, joint, is_slide) or inertia
        travel = 1.0
        if is_slide and model.jnt_limited[joint]:
            travel = _half_range(model, joint)
        speed = math.sqrt(2.0 * rated * travel / max(inertia, 1e-12))
        if damping > 0.0:
            speed = min(speed, rated / damping)
        if name in taken:
            name = f"{name}_{'force' if is_slide else 'torque'}"
        if name in (*taken, *(p.port.name for p in result)):  # such as an actuator's
            name = f"{name}_at_joint"
        units = joint_units(model, joint)
        port = Port(
            name,
            "force",
            units["force"],
            rated,
            speed,
            travel if is_slide else min(travel, _half_range(model, joint)),
            units["position"],
            bool(driven[dof]),
        )
        result.append(ForcePort(port, joint, int(model.jnt_qposadr[joint]), dof))
    return tuple(result)


def _floating_ports(
    model: Any, joint: int, name: str, inertias: Array, taken: Sequence[str]
) -> list[ForcePort]:
    """Returns the ports of a free joint or a ball: forces and torques at the body's own axes.

    The rated force is the body's weight, with all that it carries. The rated torque is the weight
    at the radius of gyration about the axis.

    Args:
        model: A ``mujoco.MjModel``.
        joint: Number of the joint.
        name: Its name.
        inertias: Mean inertia about each degree of freedom.
        taken: Names of channels, joints and other ports.
    """
    mujoco: Any = importlib.import_module("mujoco")
    first, body = int(model.jnt_dofadr[joint]), int(model.jnt_bodyid[joint])
    is_free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    mass = float(model.body_subtreemass[body])
    gravity = float(np.linalg.norm(model.opt.gravity)) or 9.81
    kinds = ("force", "torque") if is_free else ("torque",)
    result = []
    for k, (kind, axis) in enumerate(product(kinds, "xyz")):
        is_force, dof = kind == "force", first + k
        radius = math.sqrt(max(float(inertias[dof]), 1e-12) / max(mass, 1e-12))
        rated = mass * gravity * (1.0 if is_force else radius)
        travel = 1.0  # m or rad, as at other joints
        own = f"{name}_{axis}_{kind}"
        port = Port(
            own if own not in taken else f"{own}_at_joint",
            "force",
            "N" if is_force else "N m",
            rated,
            math.sqrt(2.0 * rated * travel / (mass if is_force else max(inertias[dof], 1e-12))),
            coordinate="m" if is_force else "rad",
            is_driven=False,
            is_floating=True,
        )
        result.append(ForcePort(port, joint, None, dof, k if is_force else None))
    return result


def body_axis(quaternions: Array, axis: int) -> Array:
    """Returns an axis of a body in the world's frame, ``(N, 3)``; NaN where there is no rotation.

    Args:
        quaternions: Orientations (w, x, y, z) of any length, ``(N, 4)``.
        axis: Number of the axis.
    """
    w, q = quaternions[:, 0], quaternions[:, 1:].T
    second, third = (axis + 1) % 3, (axis + 2) % 3
    result = np.empty((len(quaternions), 3))
    result[:, axis] = w * w + q[axis] ** 2 - q[second] ** 2 - q[third] ** 2
    result[:, second] = 2.0 * (q[axis] * q[second] + w * q[third])
    result[:, third] = 2.0 * (q[axis] * q[third] - w * q[second])
    with np.errstate(invalid="ignore", divide="ignore"):
        return result / np.square(quaternions).sum(1, keepdims=True)


def derive_ports(
    model: Any,
    joints: Sequence[ForcePort],
    actions: Sequence[Channel],
    sensors: Sequence[Component | Reading],
) -> tuple[Port, ...]:
    """Returns the ports of actions, joints and sensors; actions are those of all actuators."""
    by_position = {j.position: j for j in joints if j.position is not None}
    by_velocity = {joint.velocity: joint for joint in joints}
    ports = [_command_port(model, i, a, joints) for i, a in enumerate(actions)]
    ports += [joint.port for joint in joints]
    for sensor in sensors:
        rated = 1.0
        if isinstance(sensor, Component) and sensor.is_velocity:
            joint = by_velocity.get(sensor.address)
            rated = joint.port.rated_speed if joint else 1.0
        elif isinstance(sensor, Component):
            rated = _travel(model, by_position.get(sensor.address))
        elif sensor.channel.unit == "m/s²":
            rated = 9.81
        ports.append(Port(sensor.channel.name, "sensor", sensor.channel.unit, rated))
    return tuple(ports)


def _command_port(
    model: Any, actuator: int, channel: Channel, joints: Sequence[ForcePort]
) -> Port:
    """Returns the port of an actuator's command; a servo's has the ratings of its joint.

    The rated force of a servo is that of the joint, or that at an error of ``_LARGE_ERROR`` of the
    rated excursion if it is greater: a joint may carry no weight. It is the force before the gear.
    """
    if not is_servo(model, actuator):
        return Port(channel.name, "action", channel.unit, _largest(channel))
    port = Port(channel.name, "servo", channel.unit, _largest(channel))
    moved = actuated_joint(model, actuator)
    gear = abs(float(model.actuator_gear[actuator, 0])) or 1.0
    gain = float(model.actuator_gainprm[actuator, 0])
    for joint in (j.port for j in joints if j.joint == moved and j.position is not None):
        port = replace(
            port,
            rated_speed=joint.rated_speed,
            rated_position=joint.rated_position,
            coordinate=joint.coordinate,
            joint=joint.name,
            rated_force=max(joint.rated / gear, gain * _LARGE_ERROR * gear * joint.rated_position),
        )
    return port


def _largest(channel: Channel) -> float:
    """Returns the greatest magnitude of a channel, 1 if it has no bounds."""
    bound = max(abs(channel.lower), abs(channel.upper))
    return bound if math.isfinite(bound) and bound > 0.0 else 1.0


def _travel(model: Any, joint: ForcePort | None) -> float:
    """Returns a typical position of a joint: half its range, or π for a free hinge."""
    if joint is None:
        return 1.0
    if model.jnt_limited[joint.joint]:
        return _half_range(model, joint.joint)
    return math.pi if joint.port.unit == "N m" else 1.0


def _half_range(model: Any, joint: int) -> float:
    """Returns half the range of a joint, 1 if it has none."""
    if not model.jnt_limited[joint]:
        return 1.0
    return 0.5 * float(np.ptp(model.jnt_range[joint])) or 1.0


def driven_dofs(model: Any) -> NDArray[np.bool_]:
    """Returns which degrees of freedom actuators move in the file's pose, ``(nv,)``."""
    mujoco: Any = importlib.import_module("mujoco")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return np.any(actuator_moments(model, data) != 0.0, axis=0)


def actuator_moments(model: Any, data: Any) -> Array:
    """Returns the generalised force per unit of each actuator's force, ``(nu, nv)``.

    Args:
        model: A ``mujoco.MjModel``.
        data: Its ``mujoco.MjData`` after ``mj_forward``.
    """
    mujoco: Any = importlib.import_module("mujoco")
    moment = np.zeros((model.nu, model.nv))
    if model.nu:
        mujoco.mju_sparse2dense(
            moment,
            data.actuator_moment.reshape(-1),
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind.reshape(-1),
        )
    return moment


def _actuator_ratings(model: Any) -> dict[int, float]:
    """Returns the greatest total actuator force at each joint that has actuators.

    Servos count only with a limit of their force: a gain times the range of positions is far more
    than a servo has.
    """
    ratings: dict[int, float] = {}
    for actuator in range(model.nu):
        joint = actuated_joint(model, actuator)
        if joint is None:
            continue
        if model.actuator_forcelimited[actuator]:
            force = float(np.abs(model.actuator_forcerange[actuator]).max())
        elif model.actuator_ctrllimited[actuator] and not is_servo(model, actuator):
            control = float(np.abs(model.actuator_ctrlrange[actuator]).max())
            force = abs(float(model.actuator_gainprm[actuator, 0])) * control
        else:
            continue
        gear = abs(float(model.actuator_gear[actuator, 0]))
        ratings[joint] = ratings.get(joint, 0.0) + force * gear
    return {joint: rating for joint, rating in ratings.items() if rating > 0.0}


def _mean_inertias(model: Any) -> Array:
    """Returns the mean inertia about each degree of freedom in random poses, ``(nv,)``."""
    mujoco: Any = importlib.import_module("mujoco")
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    moved, lower, upper = [], [], []
    for joint in range(model.njnt):
        is_limited = bool(model.jnt_limited[joint])
        kind = int(model.jnt_type[joint])
        if kind == hinge or (kind == slide and is_limited):
            ends = model.jnt_range[joint] if is_limited else (-math.pi, math.pi)
            moved.append(int(model.jnt_qposadr[joint]))
            lower.append(float(ends[0]))
            upper.append(float(ends[1]))
    generator, data = np.random.default_rng(0), mujoco.MjData(model)
    mass, total = np.zeros((model.nv, model.nv)), np.zeros(model.nv)
    for _ in range(_NUM_POSES):
        data.qpos[moved] = generator.uniform(lower, upper)
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_crb):
            compute(model, data)
        mujoco.mj_fullM(model, data, mass)
        total += np.diag(mass)
    return total / _NUM_POSES


def _weight(model: Any, data: Any, joint: int, is_slide: bool) -> float:
    """Returns the greatest force that the weight of the subtree can exert on a joint."""
    body = int(model.jnt_bodyid[joint])
    weight = float(model.body_subtreemass[body] * np.linalg.norm(model.opt.gravity))
    if is_slide:
        return weight
    arm = data.subtree_com[body] - data.xanchor[joint]
    return weight * float(np.linalg.norm(np.cross(arm, data.xaxis[joint])))
