"""Regression of an arm's torques, without simulations.

The torques of a rigid arm are linear in its inertial and friction parameters π; see
:mod:`npdr_ppl.engines.mujoco.base_parameters`. With a constant torque c for each joint,

    Y(q, v, v̇) π + c = τ.
"""

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.base_parameters import (
    INERTIAL,
    MujocoInverseDynamics,
    actuator_forces,
    load_mjcf,
)
from npdr_ppl.engines.mujoco.batches import quiet
from npdr_ppl.engines.mujoco.fields import actuator_names, element_names
from npdr_ppl.errors import DataError, ModelError, TooShortError
from npdr_ppl.rollouts.collection import pieces
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.differentiation import (
    Smoothing,
    cutoffs,
    differentiate,
    held_actions,
    thin,
)

__all__ = ["SINGULAR", "least_squares", "load_robot", "normalised", "torque_rows"]

Array = NDArray[np.float64]

SINGULAR = 1e-6
"""Smallest singular value, relative to the largest, of a combination of parameters that counts as
determined. The columns have unit length; rounding is 1e-16, and base parameters are above 1e-3."""


def load_robot(robot: str | PathLike[str]) -> Any:
    """Returns the ``mujoco.MjModel`` of a robot whose joints are hinges and slides.

    Raises:
        ModelError: The file is not such a robot.
    """
    with quiet():  # Meshes are not needed.
        model = load_mjcf(robot)
    if model.nq != model.nv:
        raise ModelError(f"{robot} has free or ball joints; only hinges and slides are possible.")
    return model


def torque_rows(model: Any, dynamics: MujocoInverseDynamics, rollouts: Rollouts) -> Array:
    """Returns filtered Y, columns of constant torques, and τ, ``(N, nv, P + nv + 1)``.

    Args:
        model: The ``mujoco.MjModel``.
        dynamics: Its inverse dynamics.
        rollouts: Rollouts with every joint's position and every command.

    Raises:
        DataError: A joint or a command was not recorded, or the rollouts are too short.
    """
    joints, commands = element_names(model, "joint"), actuator_names(model)
    places = _places("channels", rollouts.channel_names, joints)
    inputs = _places("actions", rollouts.action_names, commands)
    rollouts = pieces(rollouts)
    measured = [np.asarray(values)[:, places] for values in rollouts.readings]
    step = rollouts.time_step
    of_positions, of_rows = cutoffs(measured, step, Smoothing())
    parts = []
    for positions, actions in zip(measured, rollouts.actions, strict=True):
        motion = differentiate(positions, step, of_positions)
        held = held_actions(np.asarray(actions)[:, inputs])
        torques = actuator_forces(model, motion.positions, motion.velocities, held)
        torques = dynamics.targets(motion.positions, motion.velocities, torques)
        moving = dynamics.regressors(motion.positions, motion.velocities, motion.accelerations)
        constant = np.broadcast_to(np.eye(model.nv), (len(moving), model.nv, model.nv))
        both = np.concatenate((moving, constant, torques[..., None]), axis=-1)
        parts.append(thin(both, step, of_rows))
    rows = np.concatenate(parts)
    needed = 2 * (rows.shape[-1] + len(INERTIAL))
    if rows.shape[0] * rows.shape[1] < needed:
        raise TooShortError(
            f"{rows.shape[0]} independent instants are left of a recording, too few for "
            f"{rows.shape[-1] - 1} parameters of the arm; record longer rollouts."
        )
    return rows


def _places(kind: str, present: tuple[str, ...], wanted: list[str]) -> list[int]:
    """Returns where names stand among those of a recording."""
    missing = [name for name in wanted if name not in present]
    if missing:
        raise DataError(
            f"This needs every joint and command of the robot, but the recording has no "
            f"{kind} {', '.join(missing)}; rename signals with a mapping."
        )
    return [present.index(name) for name in wanted]


def least_squares(matrix: Array, torques: Array, weights: Array) -> Array:
    """Returns the weighted least-squares solution of Y π = τ, ``(P,)``.

    Combinations of parameters that the motion does not determine stay zero; they change no torque.

    Args:
        matrix: Y, ``(N, nv, P)``.
        torques: τ, ``(N, nv)``.
        weights: Weight of each joint, ``(nv,)``.
    """
    columns, lengths = normalised(matrix, weights)
    target = (torques * weights).reshape(-1)
    return np.linalg.lstsq(columns, target, rcond=SINGULAR)[0] / lengths


def normalised(matrix: Array, weights: Array) -> tuple[Array, Array]:
    """Returns the weighted columns of Y with unit length, ``(N nv, P)``, and their lengths.

    Args:
        matrix: Y, ``(N, nv, P)``.
        weights: Weight of each joint, ``(nv,)``.
    """
    scaled = (matrix * weights[:, None]).reshape(-1, matrix.shape[-1])
    lengths = np.linalg.norm(scaled, axis=0)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    return scaled / lengths, lengths
