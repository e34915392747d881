"""Friction of every joint of an arm, from one motion of all joints, without simulations.

The equation Y π + c = τ of :mod:`~npdr_ppl.engines.mujoco.torque_regression` is solved by least
squares. No value of π is taken from the file, so wrong masses do not change the result. The
friction of joint j is f sign v_j + d v_j.

Reference: C. G. Atkeson, C. H. An, J. M. Hollerbach, Estimation of inertial parameters of
manipulator loads and links, 1986, Section 2.
"""

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.mujoco.base_parameters import INERTIAL, JOINT, MujocoInverseDynamics
from npdr_ppl.engines.mujoco.fields import element_names
from npdr_ppl.engines.mujoco.torque_regression import (
    SINGULAR,
    least_squares,
    load_robot,
    normalised,
    torque_rows,
)
from npdr_ppl.rollouts.container import Rollouts

__all__ = ["JointFriction", "identify_friction"]

Array = NDArray[np.float64]

LARGEST_PART = 1e-3
"""Largest part of a parameter, whose columns have unit length, in combinations of parameters that
the motion does not determine. Rounding is 1e-9. A joint that turns in one direction only has 0.7,
as dry friction is then a constant torque."""


@dataclass(frozen=True)
class JointFriction:
    """Friction of a joint.

    Friction that the motion does not determine is NaN: the dry friction of a joint that moves in
    one direction only looks like a constant torque. A joint that hardly moves has friction, but
    its values in the two halves differ widely.

    Attributes:
        dry: Dry friction f in N m or N, proportional to the recorded torques.
        viscous: Viscous friction d in N m s/rad or N s/m.
        half_dry: Dry friction from the first half of the recording alone, and from the second.
        half_viscous: The same for viscous friction.
        error: RMS error of the joint's torque, in N m or N.
        error_without: The same for a model of which this joint has no dry friction.
    """

    dry: float
    viscous: float
    half_dry: tuple[float, float]
    half_viscous: tuple[float, float]
    error: float
    error_without: float

    @property
    def share(self) -> float:
        """Share of the squared torque error that dry friction explains, beside all the rest."""
        if self.error_without == 0.0:
            return 0.0
        return 1.0 - (self.error / self.error_without) ** 2


def identify_friction(robot: str | PathLike[str], rollouts: Rollouts) -> dict[str, JointFriction]:
    """Estimates dry and viscous friction of every joint, by the joint's name.

    The arm should move slowly enough to be rigid, through various postures. Contacts and joint
    limits are not part of the equations.

    Args:
        robot: Path of an MJCF or URDF file whose joints are hinges and slides.
        rollouts: Rollouts with the position of every joint in rad or m as a channel, and every
            command of the file as an action.

    Raises:
        ModelError: The file is not such a robot.
        DataError: A joint or a command was not recorded, or the recording is too short.
    """
    model = load_robot(robot)
    dynamics = MujocoInverseDynamics(model)
    rows = torque_rows(model, dynamics, rollouts)
    weights = np.ones(model.nv)
    # Joints count by their own errors: without the weights the largest torques alone would.
    for _ in range(2):
        weights = 1.0 / np.maximum(_errors(rows, weights), 1e-12)
    errors = _errors(rows, weights)
    middle = len(rows) // 2
    parts = rows, rows[:middle], rows[middle:]
    whole, *halves = (_determined(part, weights) for part in parts)
    result = {}
    for number, name in enumerate(element_names(model, "joint")):
        first = len(INERTIAL) * len(dynamics.bodies) + len(JOINT) * number
        viscous, dry = first + JOINT.index("damping"), first + JOINT.index("frictionloss")
        without = np.delete(rows, dry, axis=-1)
        result[name] = JointFriction(
            float(whole[dry]),
            float(whole[viscous]),
            (float(halves[0][dry]), float(halves[1][dry])),
            (float(halves[0][viscous]), float(halves[1][viscous])),
            float(errors[number]),
            float(_errors(without, weights)[number]),
        )
    return result


def _solved(rows: Array, weights: Array) -> Array:
    """Returns π and the constant torques, ``(P + nv,)``."""
    return least_squares(rows[..., :-1], rows[..., -1], weights)


def _determined(rows: Array, weights: Array) -> Array:
    """Returns the same, with NaN for parameters that the motion does not determine."""
    columns, _ = normalised(rows[..., :-1], weights)
    _, sizes, directions = np.linalg.svd(columns, full_matrices=False)
    unknown = directions[sizes <= SINGULAR * sizes.max()]
    is_known = np.linalg.norm(unknown, axis=0) <= LARGEST_PART
    return np.where(is_known, _solved(rows, weights), np.nan)


def _errors(rows: Array, weights: Array) -> Array:
    """Returns the RMS error of each joint's torque, ``(nv,)``."""
    errors = rows[..., -1] - rows[..., :-1] @ _solved(rows, weights)
    return np.sqrt(np.mean(np.square(errors), axis=0))
