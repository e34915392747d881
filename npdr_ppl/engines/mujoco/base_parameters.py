"""Inverse dynamics of any MJCF, linear in its inertial and friction parameters.

A rigid body b has the mass m, the first moment h = m c and the inertia I about the origin of its
frame. Its origin has the angular velocity ω, the angular acceleration α and the proper
acceleration a (acceleration minus gravity). In the body's frame, this motion needs the wrench

    f = m a + α × h + ω × (ω × h),    n = I α + ω × (I ω) + h × a,

which is linear in (m, h, I). Its generalised force is J_bᵀ (f, n) with the body's Jacobian J_b.
Joints add armature · v̇ + damping · v + frictionloss · sign v. The sum over bodies and joints is

    Y(q, v, v̇) π = τ,

where τ is the applied forces plus other passive forces, e.g. of springs, which must be known.

Reference: C. G. Atkeson, C. H. An, J. M. Hollerbach, Estimation of inertial parameters of
manipulator loads and links, 1986, Eqs. 2–10.
"""

import importlib
import math
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.common.robot_files import is_urdf, read_robot
from npdr_ppl.engines.mujoco.urdf_files import compiled_urdf
from npdr_ppl.errors import ModelError, ShapeError

__all__ = ["INERTIAL", "JOINT", "MujocoInverseDynamics", "actuator_forces", "load_mjcf"]

Array = NDArray[np.float64]

INERTIAL = ("mass", "hx", "hy", "hz", "ixx", "iyy", "izz", "ixy", "ixz", "iyz")
"""Inertial parameters of a body, in its frame and about its origin: kg, kg m and kg m²."""

JOINT = ("damping", "frictionloss", "armature")
"""Parameters of a degree of freedom."""


MAX_REASON = 300
"""Longest part of MuJoCo's own message that is shown, in characters."""

MAX_FIELD = 1e6
"""Bound of gravity in m/s² and of wind in m/s; on the surface of the sun gravity is 274 m/s²."""


def load_mjcf(source: Any) -> Any:
    """Returns the ``mujoco.MjModel`` of an MJCF or URDF file, or the given one.

    Args:
        source: Path of a file, or a ``mujoco.MjModel``.

    Raises:
        ModelError: The file is neither MJCF nor URDF, includes a file outside of its folder, or
            describes far more than a robot.
    """
    mujoco: Any = importlib.import_module("mujoco")
    if not isinstance(source, str | PathLike):
        return source
    kind = "URDF" if is_urdf(read_robot(source)) else "MJCF"
    compiled = compiled_urdf if kind == "URDF" else mujoco.MjModel.from_xml_path
    try:
        model = compiled(str(source))
        # A model may compile although the memory that it reserves is too small for it.
        mujoco.mj_forward(model, mujoco.MjData(model))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())[:MAX_REASON].rstrip(".")
        reason = reason if reason.isprintable() else ascii(reason)
        raise ModelError(f"{source} is not a readable {kind} file: {reason}.") from error
    step, field = model.opt.timestep, np.concatenate((model.opt.gravity, model.opt.wind))
    if not (0 < step < math.inf and np.all(np.abs(field) < MAX_FIELD)):
        raise ModelError(
            f"{source} has a timestep of {step:g} s, gravity of {model.opt.gravity} m/s² and wind "
            f"of {model.opt.wind} m/s, which no robot has."
        )
    return model


@dataclass(frozen=True)
class MujocoInverseDynamics:
    """The linear form of a model's inverse dynamics.

    It does not contain contacts, joint limits and equality constraints. Models with equality
    constraints are refused, and motions should be free of contacts and joint limits.

    Args:
        model: A ``mujoco.MjModel``.

    Attributes:
        bodies: Numbers of the moving bodies, in the order of the parameters.

    Raises:
        ModelError: The model has equality constraints or no degrees of freedom.
    """

    model: Any

    def __post_init__(self) -> None:
        """Checks the model."""
        if self.model.nv == 0:
            raise ModelError("The MJCF has no joints, so motions do not depend on its parameters.")
        if self.model.neq:
            raise ModelError(
                f"The MJCF has {self.model.neq} equality constraints; inverse dynamics is linear "
                "only without them."
            )

    @property
    def bodies(self) -> tuple[int, ...]:
        """Numbers of the bodies that some joint moves."""
        return tuple(b for b in range(1, self.model.nbody) if self.model.body_weldid[b] != 0)

    def nominal(self) -> Array:
        """Returns π of the model, ``(P,)``.

        The ``INERTIAL`` parameters of every moving body come first, then the ``JOINT`` parameters
        of every degree of freedom.
        """
        model = self.model
        values = []
        for body in self.bodies:
            mass, centre = float(model.body_mass[body]), model.body_ipos[body]
            axes = _rotation(model.body_iquat[body])
            inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
            inertia = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
            values += [mass, *(mass * centre), *inertia[[0, 1, 2], [0, 1, 2]]]
            values += [inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        for dof in range(model.nv):
            values += [float(getattr(model, f"dof_{name}")[dof]) for name in JOINT]
        return np.array(values)

    def regressors(self, positions: Array, velocities: Array, accelerations: Array) -> Array:
        """Returns Y, ``(N, nv, P)``.

        Args:
            positions: MuJoCo's qpos, ``(N, nq)``.
            velocities: Its qvel, ``(N, nv)``.
            accelerations: Its qacc, ``(N, nv)``.

        Raises:
            ShapeError: The shapes do not fit the model.
        """
        return self._evaluate(positions, velocities, accelerations)[0]

    def targets(self, positions: Array, velocities: Array, applied: Array) -> Array:
        """Returns τ, ``(N, nv)``: applied forces plus forces of springs, tendons and fluids.

        Args:
            positions: MuJoCo's qpos, ``(N, nq)``.
            velocities: Its qvel, ``(N, nv)``.
            applied: Applied generalised forces, including those of actuators, ``(N, nv)``.

        Raises:
            ShapeError: The shapes do not fit the model.
        """
        if applied.shape != velocities.shape:
            raise ShapeError(
                f"Applied forces must have the velocities' shape {velocities.shape}, got "
                f"{applied.shape}."
            )
        return applied + self._evaluate(positions, velocities, np.zeros_like(velocities))[1]

    def _evaluate(self, positions: Array, velocities: Array, accelerations: Array) -> Any:
        """Returns Y, and the passive forces without the damping of the joints."""
        mujoco: Any = importlib.import_module("mujoco")
        model, bodies = self.model, self.bodies
        self._check_shapes(positions, velocities, accelerations)
        data = mujoco.MjData(model)
        num = len(INERTIAL) * len(bodies) + len(JOINT) * model.nv
        rows = np.zeros((len(positions), model.nv, num))
        passive = np.zeros((len(positions), model.nv))
        linear, angular = np.zeros((2, 3, model.nv))
        twist, acceleration = np.zeros((2, 6))
        for n in range(len(positions)):
            data.qpos[:], data.qvel[:] = positions[n], velocities[n]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            data.qacc[:] = accelerations[n]
            mujoco.mj_rnePostConstraint(model, data)
            passive[n] = data.qfrc_passive + model.dof_damping * data.qvel
            for k, body in enumerate(bodies):
                frame = mujoco.mjtObj.mjOBJ_XBODY
                mujoco.mj_objectVelocity(model, data, frame, body, twist, 1)
                # MuJoCo's accelerations include minus gravity.
                mujoco.mj_objectAcceleration(model, data, frame, body, acceleration, 1)
                mujoco.mj_jacBody(model, data, linear, angular, body)
                axes = data.xmat[body].reshape(3, 3)
                wrench = _wrench(twist[:3], acceleration[:3], acceleration[3:])
                forces = (axes.T @ linear).T @ wrench[:3] + (axes.T @ angular).T @ wrench[3:]
                rows[n, :, 10 * k : 10 * k + 10] = forces
        start = 10 * len(bodies)
        for dof in range(model.nv):
            columns = (velocities[:, dof], np.sign(velocities[:, dof]), accelerations[:, dof])
            rows[:, dof, start + 3 * dof : start + 3 * dof + 3] = np.stack(columns, axis=-1)
        return rows, passive

    def _check_shapes(self, *arrays: Array) -> None:
        wanted = (self.model.nq, self.model.nv, self.model.nv)
        for name, array, width in zip(
            ("positions", "velocities", "accelerations"), arrays, wanted, strict=True
        ):
            if array.shape != (len(arrays[0]), width):
                raise ShapeError(
                    f"{name} must have shape ({len(arrays[0])}, {width}), got {array.shape}."
                )


def actuator_forces(model: Any, positions: Array, velocities: Array, controls: Array) -> Array:
    """Returns the generalised forces of a model's actuators, ``(N, nv)``.

    Args:
        model: A ``mujoco.MjModel`` whose actuators have no state of their own.
        positions: Its qpos, ``(N, nq)``.
        velocities: Its qvel, ``(N, nv)``.
        controls: Its ctrl, ``(N, nu)``.

    Raises:
        ModelError: An actuator has a state.
    """
    mujoco: Any = importlib.import_module("mujoco")
    if model.na:
        raise ModelError(
            "Actuators with states have forces that do not follow from the control alone."
        )
    data = mujoco.MjData(model)
    forces = np.zeros((len(positions), model.nv))
    for n in range(len(positions)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = positions[n], velocities[n], controls[n]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        forces[n] = data.qfrc_actuator
    return forces


def _wrench(spin: Array, turn: Array, acceleration: Array) -> Array:
    """Returns the wrench (f, n) per unit of each inertial parameter, ``(6, 10)``."""
    wrench = np.zeros((6, 10))
    wrench[:3, 0] = acceleration
    wrench[:3, 1:4] = _cross(turn) + _cross(spin) @ _cross(spin)
    wrench[3:, 1:4] = -_cross(acceleration)
    wrench[3:, 4:] = _inertia_times(turn) + _cross(spin) @ _inertia_times(spin)
    return wrench


def _cross(v: Array) -> Array:
    """Returns the matrix of v ×."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _inertia_times(v: Array) -> Array:
    """Returns the matrix that takes (ixx, iyy, izz, ixy, ixz, iyz) to I v, ``(3, 6)``."""
    x, y, z = v
    return np.array([[x, 0.0, 0.0, y, z, 0.0], [0.0, y, 0.0, x, 0.0, z], [0.0, 0.0, z, 0.0, x, y]])


def _rotation(quaternion: Array) -> Array:
    """Returns the rotation matrix of a unit quaternion (w, x, y, z)."""
    mujoco: Any = importlib.import_module("mujoco")
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
