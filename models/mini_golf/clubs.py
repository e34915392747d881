"""The strikers of the ball: the club head alone, or the whole arm that holds it.

Both follow the joints' recorded angles and have the corresponding velocity at every contact. A
body that is only moved from pose to pose would have no velocity and transfer no momentum. The head
alone launches the ball as the whole arm does, in a fraction of the computing time.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from npdr_ppl.models.mini_golf.course import CLUB_HEAD_SIZE, CLUB_MASS, DEFAULT_FRICTION
from npdr_ppl.models.mini_golf.kinematics import BASE, CLUB, HEAD, JOINTS, Pose, head_path

__all__ = ["Club", "ClubHead", "ClubKind", "WholeArm", "club_of"]

Array = NDArray[np.float64]

ClubKind = Literal["head", "arm"]

ASIDE = (0.0, 0.0, 100.0), (0.0, 0.0, 0.0, 1.0)
"""Position in m and quaternion of the head while it is out of reach. It falls there without any
effect."""

MOTOR_FORCE = 1e5
"""Maximum torque of a joint's motor in N m, large enough for the joint to follow its commands."""

LINK_RADIUS = 0.05
"""Radius in m of the sphere that represents a link. Its inertia and mass have no influence,
because the joints follow their commands."""


class Club(ABC):
    """A striker that is moved along a recorded swing.

    Args:
        angles: Joint angles in rad at the M + 1 boundaries of sub-steps, ``(M + 1, 7)``.
        sub_step: Seconds per sub-step.
        sub_steps: Number of sub-steps per step.
        gravity: Acceleration of gravity in m/s².
    """

    def __init__(self, angles: Array, sub_step: float, sub_steps: int, gravity: float) -> None:
        self.angles, self.sub_step = angles, sub_step
        self.sub_steps, self.gravity = sub_steps, gravity

    @abstractmethod
    def build(self, client: Any, restitution: float) -> tuple[int, int]:
        """Adds the club to a scene.

        Returns:
            Body and link of the head.
        """

    @abstractmethod
    def follower(self, client: Any, body: int) -> Callable[[int], None]:
        """Returns a function that sets the club's pose and velocity just before a sub-step."""

    @abstractmethod
    def put_aside(self, client: Any, body: int) -> None:
        """Prepares the club for the steps in which it is out of the ball's reach."""

    @cached_property
    def poses(self) -> Pose:
        """Poses of the head's centre at the boundaries of sub-steps."""
        return head_path(self.angles)

    @cached_property
    def ground_track(self) -> Array:
        """X and y of the head at the start of every step in m, ``(steps, 2)``."""
        return self.poses.position[: -1 : self.sub_steps, :2]


class ClubHead(Club):
    """The head alone, moved by the arm's forward kinematics; see :class:`Club`."""

    def build(self, client: Any, restitution: float) -> tuple[int, int]:
        """Adds the head; see :meth:`Club.build`."""
        body = client.createMultiBody(
            baseMass=CLUB_MASS,
            baseCollisionShapeIndex=_head_shape(client),
            basePosition=ASIDE[0],
        )
        _set_surface(client, body, -1, restitution)
        return body, -1

    def follower(self, client: Any, body: int) -> Callable[[int], None]:
        """Returns the function that moves the head; see :meth:`Club.follower`."""
        # Looked up once, because the client wraps a function anew at each access.
        place, push = client.resetBasePositionAndOrientation, client.resetBaseVelocity
        positions, quaternions = self._positions, self._quaternions
        velocities, rates = self.velocities, self.rates

        def follow(k: int) -> None:
            place(body, positions[k], quaternions[k])
            push(body, velocities[k], rates[k])

        return follow

    def put_aside(self, client: Any, body: int) -> None:
        """Moves the head away from all bodies."""
        client.resetBasePositionAndOrientation(body, *ASIDE)

    # Lists, because one swing is used for thousands of strikes and Bullet takes numbers.

    @cached_property
    def _positions(self) -> list[list[float]]:
        return self.poses.position.tolist()

    @cached_property
    def _quaternions(self) -> list[list[float]]:
        return self.poses.quaternion().tolist()

    @cached_property
    def velocities(self) -> list[list[float]]:
        """Mean velocities in sub-steps in m/s, plus a compensation of gravity."""
        velocities = np.diff(self.poses.position, axis=0) / self.sub_step
        velocities[:, 2] += self.gravity * self.sub_step
        return velocities.tolist()

    @cached_property
    def rates(self) -> list[list[float]]:
        """Mean angular velocities in sub-steps in rad/s."""
        rotation = self.poses.rotation
        turned = rotation[1:] @ rotation[:-1].swapaxes(-1, -2)
        return (Rotation.from_matrix(turned).as_rotvec() / self.sub_step).tolist()


class WholeArm(Club):
    """Seven links, the club and its head as one multi-body; see :class:`Club`.

    Every joint is set to its angle and velocity. Its motor holds the velocity against gravity and
    the impact.
    """

    def build(self, client: Any, restitution: float) -> tuple[int, int]:
        """Adds the arm; see :meth:`Club.build`."""
        matter = client.createCollisionShape(client.GEOM_SPHERE, radius=LINK_RADIUS)
        frames = [joint.frame for joint in JOINTS] + [CLUB @ HEAD]
        masses = [joint.mass for joint in JOINTS] + [CLUB_MASS]
        count = len(frames)
        body = client.createMultiBody(
            baseMass=0.0,
            basePosition=BASE.position.tolist(),
            baseOrientation=BASE.quaternion().tolist(),
            linkMasses=masses,
            linkCollisionShapeIndices=[matter] * len(JOINTS) + [_head_shape(client)],
            linkVisualShapeIndices=[-1] * count,
            linkPositions=[frame.position.tolist() for frame in frames],
            linkOrientations=[frame.quaternion().tolist() for frame in frames],
            linkInertialFramePositions=[(0.0, 0.0, 0.0)] * count,
            linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)] * count,
            linkParentIndices=list(range(count)),
            linkJointTypes=[client.JOINT_REVOLUTE] * len(JOINTS) + [client.JOINT_FIXED],
            linkJointAxis=[(0.0, 0.0, 1.0)] * count,
        )
        for link in range(len(JOINTS)):
            client.changeDynamics(body, link, jointDamping=0.0)
            client.setCollisionFilterGroupMask(body, link, 0, 0)
        _set_surface(client, body, len(JOINTS), restitution)
        return body, len(JOINTS)

    def follower(self, client: Any, body: int) -> Callable[[int], None]:
        """Returns the function that moves the joints; see :meth:`Club.follower`."""
        place, control = client.resetJointState, client.setJointMotorControlArray

        def follow(k: int) -> None:
            angles, rates = self._angles[k], self._rates[k]
            for joint, (angle, rate) in enumerate(zip(angles, rates, strict=True)):
                place(body, joint, angle, rate)
            control(
                body,
                range(len(rates)),
                client.VELOCITY_CONTROL,
                targetVelocities=rates,
                forces=[MOTOR_FORCE] * len(rates),
            )

        return follow

    def put_aside(self, client: Any, body: int) -> None:
        """Stops the joints: the arm stays where it left the ball."""
        client.setJointMotorControlArray(
            body,
            range(len(JOINTS)),
            client.VELOCITY_CONTROL,
            targetVelocities=[0.0] * len(JOINTS),
            forces=[MOTOR_FORCE] * len(JOINTS),
        )

    @cached_property
    def _angles(self) -> list[list[float]]:
        return self.angles.tolist()

    @cached_property
    def _rates(self) -> list[list[float]]:
        return (np.diff(self.angles, axis=0) / self.sub_step).tolist()


def club_of(
    kind: ClubKind, angles: Array, sub_step: float, sub_steps: int, gravity: float
) -> Club:
    """Returns the club of a kind; see :class:`Club` for the other arguments."""
    kinds: dict[str, type[Club]] = {"head": ClubHead, "arm": WholeArm}
    return kinds[kind](angles, sub_step, sub_steps, gravity)


def _head_shape(client: Any) -> int:
    return client.createCollisionShape(
        client.GEOM_BOX, halfExtents=[0.5 * size for size in CLUB_HEAD_SIZE]
    )


def _set_surface(client: Any, body: int, link: int, restitution: float) -> None:
    client.changeDynamics(
        body,
        link,
        lateralFriction=DEFAULT_FRICTION,
        spinningFriction=0.0,
        rollingFriction=0.0,
        restitution=restitution,
        linearDamping=0.0,
        angularDamping=0.0,
    )
