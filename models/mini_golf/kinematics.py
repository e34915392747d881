"""Forward kinematics of the arm that holds the club: from seven angles to the head's pose.

A transform is a translation followed by intrinsic rotations about x, y and z; a joint is its
transform followed by a rotation about its own z axis.
"""

import math
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["BASE", "CLUB", "HEAD", "JOINTS", "Joint", "Pose", "head_path"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """A rigid transform, or one for each of N samples.

    Attributes:
        position: Translation in m, ``(3,)`` or ``(N, 3)``.
        rotation: Rotation matrix, ``(3, 3)`` or ``(N, 3, 3)``.
    """

    position: Array
    rotation: Array

    @classmethod
    def of(cls, x: float, y: float, z: float, a: float = 0, b: float = 0, c: float = 0) -> "Pose":
        """Returns the transform (x, y, z; a, b, c), in m and degrees."""
        turn = Rotation.from_euler("XYZ", (a, b, c), degrees=True)
        return cls(np.array((x, y, z), dtype=float), turn.as_matrix())

    def __matmul__(self, other: "Pose") -> "Pose":
        """Returns this transform followed by ``other``, which is given in this one's frame."""
        position = self.position + np.einsum("...ij,...j->...i", self.rotation, other.position)
        return Pose(position, self.rotation @ other.rotation)

    def quaternion(self) -> Array:
        """Returns the rotation as (x, y, z, w), ``(4,)`` or ``(N, 4)``."""
        return Rotation.from_matrix(self.rotation).as_quat()


@dataclass(frozen=True)
class Joint:
    """A revolute joint and the link behind it.

    Attributes:
        frame: Transform from the previous frame to the joint's own.
        lower: Minimum angle in rad.
        upper: Maximum angle in rad.
        mass: Mass of the link in kg.
    """

    frame: Pose
    lower: float
    upper: float
    mass: float


def _joint(frame: Pose, lower: float, upper: float, mass: float) -> Joint:
    return Joint(frame, math.radians(lower), math.radians(upper), mass)


BASE = reduce(
    Pose.__matmul__,
    (
        Pose.of(0, 0, 0, 0, 0, 90),  # table
        Pose.of(0.1975, 0, 0),  # column
        Pose.of(0, 0, 1.2),  # height
        Pose.of(0.11, 0, 0),  # base
    ),
)
"""From the world to the arm's base."""

JOINTS = (
    _joint(Pose.of(0, 0, 0.12), -170, 170, 3.6),
    _joint(Pose.of(0.175, 0, 0, 0, 90, 0), -260, 80, 3.6),
    _joint(Pose.of(0, 0, 0.175, 0, -90, 0), -115, 115, 2.0),
    _joint(Pose.of(0.1515, 0, 0, 0, 90, 0), -260, 80, 2.0),
    _joint(Pose.of(0, 0, 0.2115, 0, -90, 0), -110, 115, 1.2),
    _joint(Pose.of(0.12575, 0, 0, 0, 90, 0), -350, 0, 1.2),
    _joint(Pose.of(0, 0, 0.16575, 0, -90, 0), -120, 120, 1.0),
)
"""The seven joints, base to tip."""

CLUB = Pose.of(0.164, -0.02, -0.01, 0, 90, -165)
"""From the last joint to the club, whose shaft points along the club's −y axis."""

HEAD = Pose.of(0.01, -0.945, 0, 0, 0, 57)
"""From the club to the centre of its head."""


def head_path(angles: Array) -> Pose:
    """Returns the pose of the club head's centre for every row of joint angles.

    Args:
        angles: Joint angles in rad, ``(N, 7)``.
    """
    pose = BASE
    for joint, angle in zip(JOINTS, angles.T, strict=True):
        turn = Rotation.from_rotvec(angle[:, None] * np.array((0.0, 0.0, 1.0))).as_matrix()
        pose = pose @ joint.frame @ Pose(np.zeros(3), turn)
    return pose @ CLUB @ HEAD
