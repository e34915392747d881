"""Mass and centre of a load, from one motion without it and one with it, without simulations.

The torques of a rigid arm are linear in its inertial and friction parameters π; see
:mod:`npdr_ppl.engines.mujoco.base_parameters`. A load adds its mass m, first moment h = m c and
inertia I to one body, so that with the columns Y_b of that body

    Y π = τ  without the load,    Y π + Y_b (m, h, I) = τ  with it.

Both equations are solved together by least squares, with a constant torque for each joint in
addition. No value of π is taken from the file, so an arm's wrong masses do not change the result.

Reference: C. G. Atkeson, C. H. An, J. M. Hollerbach, Estimation of inertial parameters of
manipulator loads and links, 1986, Section 3.
"""

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.base_parameters import INERTIAL, MujocoInverseDynamics
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.torque_regression import (
    SINGULAR,
    least_squares,
    load_robot,
    torque_rows,
)
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.registry import hint
from npdr_ppl.rollouts.container import Rollouts

__all__ = [
    "Payload",
    "identify_payload",
]

Array = NDArray[np.float64]

LEAST_OWN = 1e-3
"""Least share of the torques per kg of a load that its moment and inertia cannot cause. Near the
base they cause all of them, and the share is rounding, 1e-15 at a UR10e's upper arm."""


@dataclass(frozen=True)
class Payload:
    """A load at a body of an arm.

    Attributes:
        body: Name of the body.
        mass: Mass in kg. It is proportional to the recorded torques.
        centre: Centre of mass (x, y, z) in m, in the frame of the body.
        half_masses: Mass in kg from the first half of both recordings alone, and from the second.
        errors: RMS error of the torque of each joint by name, in N m or N: without the load, with
            the load if the model has none, and with the load in the model.
    """

    body: str
    mass: float
    centre: tuple[float, float, float]
    half_masses: tuple[float, float]
    errors: dict[str, tuple[float, float, float]]


def identify_payload(
    robot: str | PathLike[str], without: Rollouts, loaded: Rollouts, body: str
) -> Payload:
    """Estimates the load that a robot carries in one of two recordings.

    The robot should move alike in both, slowly enough to be rigid, through various postures.
    Contacts and joint limits are not part of the equations.

    Args:
        robot: Path of an MJCF or URDF file whose joints are hinges and slides.
        without: Rollouts without the load, with the position of every joint in rad or m as a
            channel, and every command of the file as an action.
        loaded: Rollouts with it.
        body: Name of the body that carries it.

    Raises:
        ModelError: The file is not such a robot, or has no such moving body.
        DataError: A joint or a command was not recorded, or the recordings are too short.
    """
    model = load_robot(robot)
    dynamics = MujocoInverseDynamics(model)
    names = element_names(model, "body")
    moving = [names[number] for number in dynamics.bodies]
    if body not in moving:
        raise ModelError(f"{robot} has no moving body {body!r}; {hint(body, moving)}")
    first = len(INERTIAL) * moving.index(body)
    columns = slice(first, first + len(INERTIAL))
    empty, full = (torque_rows(model, dynamics, rollouts) for rollouts in (without, loaded))
    _check_mass(full, columns, body)
    # Joints count by their own errors: without the weights the largest torques alone would.
    weights = np.ones(model.nv)
    for _ in range(2):
        _, *errors = _solve(empty, full, columns, weights)
        weights = 1.0 / np.maximum(_rms(np.concatenate(errors)), 1e-12)
    values, *errors = _solve(empty, full, columns, weights)
    masses = [
        _solve(before, after, columns, weights)[0][0]
        for before, after in zip(_halves(empty), _halves(full), strict=True)
    ]
    ignored = errors[1] + full[..., columns] @ values
    kinds = (_rms(errors[0]).tolist(), _rms(ignored).tolist(), _rms(errors[1]).tolist())
    joints = element_names(model, "joint")
    mass, *moments = values[:4].tolist()
    if mass == 0.0:
        raise DataError(f"The recordings contain no torques, so no load at {body!r} can be found.")
    centre = (moments[0] / mass, moments[1] / mass, moments[2] / mass)
    half_masses = (float(masses[0]), float(masses[1]))
    by_joint = dict(zip(joints, zip(*kinds, strict=True), strict=True))
    return Payload(body, mass, centre, half_masses, by_joint)


def _solve(
    empty: Array, full: Array, columns: slice, weights: Array
) -> tuple[Array, Array, Array]:
    """Returns the load's parameters, and the torque errors without and with it, ``(N, nv)``."""
    absent = np.zeros((*empty.shape[:2], len(INERTIAL)))
    above = np.concatenate((empty[..., :-1], absent), axis=-1)
    below = np.concatenate((full[..., :-1], full[..., columns]), axis=-1)
    matrix = np.concatenate((above, below))
    torques = np.concatenate((empty[..., -1], full[..., -1]))
    solution = least_squares(matrix, torques, weights)
    errors = torques - matrix @ solution
    return solution[-len(INERTIAL) :], errors[: len(empty)], errors[len(empty) :]


def _check_mass(full: Array, columns: slice, body: str) -> None:
    """Raises a DataError if the load's moment and inertia explain all torques of its mass."""
    load = full[..., columns].reshape(-1, len(INERTIAL))
    mass, others = load[:, 0], load[:, 1:]
    rest = mass - others @ np.linalg.lstsq(others, mass, rcond=SINGULAR)[0]
    if np.linalg.norm(rest) <= LEAST_OWN * np.linalg.norm(mass):
        raise DataError(
            f"The motion does not tell the mass of a load at {body!r}, only its moments; name a "
            "body farther from the base, or move more joints."
        )


def _halves(rows: Array) -> tuple[Array, Array]:
    middle = len(rows) // 2
    return rows[:middle], rows[middle:]


def _rms(errors: Array) -> Array:
    return np.sqrt(np.mean(np.square(errors), axis=0))
