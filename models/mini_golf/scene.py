"""The mini-golf course in PyBullet, and one strike on it.

How contacts are solved is part of the model, so it is fixed here:

* four sub-steps of 2.5 ms per sample and 20 solver iterations;
* Bullet combines restitutions, frictions and rolling frictions of two bodies as it does by
  default: the products of restitutions and of frictions, and for rolling the sum of each body's
  rolling friction (m) times the other's friction;
* the head pushes the ball alone, the rest of the world the ball alone;
* a contact exists from 10 µm on and overlaps are not pushed apart by springs (contact ERP 0). By
  Bullet's default of 2 cm, contacts are foreseen one ball radius ahead and swallow the rebound.
  The threshold belongs to the process and outlives a reset, so every strike sets it;
* no damping in the air, and the bodies never sleep.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from npdr_ppl.engines.bullet.client import connect
from npdr_ppl.engines.bullet.settings import BulletSettings
from npdr_ppl.models.mini_golf.course import (
    CLUB_HEAD_SIZE,
    CLUB_MASS,
    DEFAULT_FRICTION,
    HOLE,
    HOLE_DEPTH,
    HOLE_FRICTION,
    HOLE_RISE,
    OBSTACLES,
    RAILS,
    Box,
    StrikeParameters,
)
from npdr_ppl.models.mini_golf.kinematics import Pose

__all__ = ["GRAVITY", "HeadPath", "Scene", "SUB_STEPS"]

Array = NDArray[np.float64]

SETTINGS = BulletSettings(
    time_step=0.01,
    substeps=4,
    solver_iterations=20,
    contact_breaking_threshold=1e-5,
    contact_erp=0.0,
    restitution_velocity_threshold=0.0,
)
SUB_STEPS = SETTINGS.substeps
GRAVITY = -SETTINGS.gravity[2]

REACH = 0.15
"""Distance in m of ball and club head beyond which the head is not moved: the ball has a radius
of 2.6 cm at most, the head a half-diagonal of 3.7 cm."""

REST_SPEED = 1e-4
"""Speed in m/s, and speed of the surface, below which a ball that nothing will push lies still:
rolling friction stops it within a micrometre."""

STEPS_PER_REST_CHECK = 10

ASIDE = (0.0, 0.0, 100.0), (0.0, 0.0, 0.0, 1.0)
"""Where the head is when it is out of reach: it falls there, which is no one's business."""

_BALL, _WORLD, _HEAD = 1, 2, 4
"""Collision groups; the ball meets both others, which do not meet each other."""


@dataclass(frozen=True)
class HeadPath:
    """Where the club head is at the start of each of M sub-steps, and how it moves in it.

    Plain lists, because one path serves thousands of strikes and Bullet's functions take numbers.

    Attributes:
        positions: Positions of its centre in m, M of (x, y, z).
        quaternions: Rotations, M of (x, y, z, w).
        velocities: Mean velocities in m/s, plus what gravity takes in a sub-step: the head is
            held up.
        rates: Mean angular velocities in rad/s.
        ground_track: x and y at the start of every step in m, ``(M / SUB_STEPS, 2)``.
    """

    positions: list[list[float]]
    quaternions: list[list[float]]
    velocities: list[list[float]]
    rates: list[list[float]]
    ground_track: Array

    @classmethod
    def of(cls, poses: Pose, sub_step: float) -> "HeadPath":
        """Derives velocities from poses at the M + 1 bounds of sub-steps of ``sub_step`` s."""
        velocities = np.diff(poses.position, axis=0) / sub_step
        velocities[:, 2] += GRAVITY * sub_step
        turned = poses.rotation[1:] @ poses.rotation[:-1].swapaxes(-1, -2)
        rates = Rotation.from_matrix(turned).as_rotvec() / sub_step
        return cls(
            poses.position[:-1].tolist(),
            poses.quaternion()[:-1].tolist(),
            velocities.tolist(),
            rates.tolist(),
            poses.position[:-1:SUB_STEPS, :2],
        )


class Scene:
    """A connection to Bullet in which strikes are simulated, one after the other.

    Each strike builds the course anew, so that its result depends on its arguments alone.
    """

    def __init__(self) -> None:
        self._client: Any = connect()

    def close(self) -> None:
        """Ends the connection."""
        self._client.disconnect()

    def strike(
        self, parameters: StrikeParameters, ball: Array, head: HeadPath, time_step: float
    ) -> Array:
        """Simulates one strike.

        Args:
            parameters: The course and the ball.
            ball: Where the ball lies at the start in m, ``(2,)``.
            head: The club head's path over K steps, K · ``SUB_STEPS`` samples.
            time_step: Seconds per step.

        Returns:
            The ball's x and y after each step in m, ``(K, 2)``.
        """
        body, head_body = self._build(parameters, ball, time_step)
        return self._run(body, head_body, head, parameters.ball_radius)

    def _run(self, ball: int, head_body: int, head: HeadPath, radius: float) -> Array:
        client = self._client
        place, push = client.resetBasePositionAndOrientation, client.resetBaseVelocity
        locate, step_simulation = client.getBasePositionAndOrientation, client.stepSimulation
        track = head.ground_track
        result = np.empty((len(track), 2))
        (x, y, _), _ = locate(ball)
        is_near = True
        for step, (head_x, head_y) in enumerate(track.tolist()):
            was_near = is_near
            is_near = (head_x - x) ** 2 + (head_y - y) ** 2 < REACH**2
            if was_near and not is_near:
                place(head_body, *ASIDE)
            for k in range(step * SUB_STEPS, (step + 1) * SUB_STEPS):
                if is_near:
                    place(head_body, head.positions[k], head.quaternions[k])
                    push(head_body, head.velocities[k], head.rates[k])
                step_simulation()
            (x, y, _), _ = locate(ball)
            result[step] = x, y
            if is_near or step % STEPS_PER_REST_CHECK or not self._is_at_rest(ball, radius):
                continue
            if np.linalg.norm(track[step:] - (x, y), axis=-1).min() > REACH:
                result[step:] = x, y
                break
        return result

    def _is_at_rest(self, ball: int, radius: float) -> bool:
        linear, angular = self._client.getBaseVelocity(ball)
        return max(*map(abs, linear), radius * max(map(abs, angular))) < REST_SPEED

    def _build(
        self, parameters: StrikeParameters, ball: Array, time_step: float
    ) -> tuple[int, int]:
        client = self._client
        self._sub_step = time_step / SUB_STEPS
        client.resetSimulation()
        client.setPhysicsEngineParameter(enableFileCaching=0, **SETTINGS.engine_parameters())
        client.setTimeStep(self._sub_step)
        client.setGravity(*SETTINGS.gravity)
        obstacle = parameters.obstacle_restitution
        ground = client.createCollisionShape(client.GEOM_BOX, halfExtents=(4.0, 4.0, 0.5))
        self._body(ground, (0.0, 0.0, -0.5), _WORLD, friction=parameters.ground_friction)
        for box in RAILS:
            self._box(box, obstacle)
        for box, shift in zip(OBSTACLES, parameters.obstacle_shifts, strict=True):
            self._box(box.moved(*shift), obstacle)
        hole = client.createCollisionShape(
            client.GEOM_CYLINDER,
            radius=parameters.hole_radius,
            height=HOLE_DEPTH,
        )
        place = (*HOLE, HOLE_RISE - 0.5 * HOLE_DEPTH)
        self._body(hole, place, _WORLD, friction=HOLE_FRICTION, rolling=HOLE_FRICTION)
        sphere = client.createCollisionShape(client.GEOM_SPHERE, radius=parameters.ball_radius)
        ball_body = self._body(
            sphere,
            (float(ball[0]), float(ball[1]), parameters.ball_radius),
            _BALL,
            mass=parameters.ball_mass,
            friction=parameters.ball_friction,
            rolling=parameters.ball_rolling_friction,
            restitution=1.0,
        )
        inertia = parameters.ball_inertia_factor * parameters.ball_mass * parameters.ball_radius**2
        client.changeDynamics(ball_body, -1, localInertiaDiagonal=(inertia,) * 3)
        head_shape = client.createCollisionShape(
            client.GEOM_BOX,
            halfExtents=tuple(0.5 * size for size in CLUB_HEAD_SIZE),
        )
        head_body = self._body(
            head_shape,
            ASIDE[0],
            _HEAD,
            mass=CLUB_MASS,
            restitution=parameters.club_restitution,
        )
        return ball_body, head_body

    def _box(self, box: Box, restitution: float) -> None:
        client = self._client
        shape = client.createCollisionShape(
            client.GEOM_BOX, halfExtents=tuple(0.5 * s for s in box.size)
        )
        half = 0.5 * box.angle
        self._body(
            shape,
            box.centre,
            _WORLD,
            orientation=(0.0, 0.0, np.sin(half), np.cos(half)),
            restitution=restitution,
        )

    def _body(
        self,
        shape: int,
        position: tuple[float, float, float],
        group: int,
        *,
        orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
        mass: float = 0.0,
        friction: float = DEFAULT_FRICTION,
        rolling: float = 0.0,
        restitution: float = 0.0,
    ) -> int:
        client = self._client
        body = client.createMultiBody(
            baseMass=mass,
            baseCollisionShapeIndex=shape,
            basePosition=position,
            baseOrientation=orientation,
        )
        client.changeDynamics(
            body,
            -1,
            lateralFriction=friction,
            spinningFriction=0.0,
            rollingFriction=rolling,
            restitution=restitution,
            linearDamping=0.0,
            angularDamping=0.0,
        )
        mask = _BALL if group != _BALL else _WORLD | _HEAD
        client.setCollisionFilterGroupMask(body, -1, group, mask)
        return body
