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

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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

SUB_STEPS = 4
"""Sub-steps per sample of 10 ms."""

SOLVER_ITERATIONS = 20
GRAVITY = 9.81

CONTACT_THRESHOLD = 1e-5
"""Distance in m from which on two bodies touch."""

REACH = 0.15
"""Distance in m of ball and club head beyond which the head is not moved: the ball has a radius
of 2.6 cm at most, the head a half-diagonal of 3.7 cm."""

REST_SPEED = 1e-4
"""Speed in m/s, and speed of the surface, below which a ball that nothing will push lies still:
rolling friction stops it within a micrometre."""

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
        self._bullet: Any = importlib.import_module("pybullet")
        self._client: int = self._bullet.connect(self._bullet.DIRECT)

    def close(self) -> None:
        """Ends the connection."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1

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
        p, client = self._bullet, self._client
        num_steps = len(head.positions) // SUB_STEPS
        result = np.empty((num_steps, 2))
        positions, quaternions = head.positions, head.quaternions
        velocities, rates = head.velocities, head.rates
        (x, y, _), _ = p.getBasePositionAndOrientation(ball, physicsClientId=client)
        is_near = True
        for step in range(num_steps):
            was_near = is_near
            hx, hy = positions[step * SUB_STEPS][:2]
            is_near = (hx - x) ** 2 + (hy - y) ** 2 < REACH**2
            if was_near and not is_near:
                p.resetBasePositionAndOrientation(
                    head_body, (0.0, 0.0, 100.0), (0.0, 0.0, 0.0, 1.0), physicsClientId=client
                )
            for k in range(step * SUB_STEPS, (step + 1) * SUB_STEPS):
                if is_near:
                    p.resetBasePositionAndOrientation(
                        head_body, positions[k], quaternions[k], physicsClientId=client
                    )
                    p.resetBaseVelocity(
                        head_body, velocities[k], rates[k], physicsClientId=client
                    )
                p.stepSimulation(physicsClientId=client)
            (x, y, _), _ = p.getBasePositionAndOrientation(ball, physicsClientId=client)
            result[step] = x, y
            if not is_near and step % 10 == 0:
                linear, angular = p.getBaseVelocity(ball, physicsClientId=client)
                surface = radius * max(map(abs, angular))
                if max(*map(abs, linear), surface) < REST_SPEED:
                    distance = np.linalg.norm(head.ground_track[step:] - (x, y), axis=-1)
                    if distance.min() > REACH:
                        result[step:] = x, y
                        break
        return result

    def _build(
        self, parameters: StrikeParameters, ball: Array, time_step: float
    ) -> tuple[int, int]:
        p, client = self._bullet, self._client
        self._sub_step = time_step / SUB_STEPS
        p.resetSimulation(physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=self._sub_step,
            numSubSteps=1,
            numSolverIterations=SOLVER_ITERATIONS,
            contactBreakingThreshold=CONTACT_THRESHOLD,
            contactERP=0.0,
            restitutionVelocityThreshold=0.0,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=client,
        )
        p.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        obstacle = parameters.obstacle_restitution
        ground = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=(4.0, 4.0, 0.5), physicsClientId=client
        )
        self._body(ground, (0.0, 0.0, -0.5), _WORLD, friction=parameters.ground_friction)
        for box in RAILS:
            self._box(box, obstacle)
        for box, shift in zip(OBSTACLES, parameters.obstacle_shifts, strict=True):
            self._box(box.moved(*shift), obstacle)
        hole = p.createCollisionShape(
            p.GEOM_CYLINDER,
            radius=parameters.hole_radius,
            height=HOLE_DEPTH,
            physicsClientId=client,
        )
        place = (*HOLE, HOLE_RISE - 0.5 * HOLE_DEPTH)
        self._body(hole, place, _WORLD, friction=HOLE_FRICTION, rolling=HOLE_FRICTION)
        sphere = p.createCollisionShape(
            p.GEOM_SPHERE, radius=parameters.ball_radius, physicsClientId=client
        )
        ball_body = self._body(
            sphere,
            (float(ball[0]), float(ball[1]), parameters.ball_radius),
            _BALL,
            mass=parameters.ball_mass,
            friction=parameters.ball_friction,
            rolling=parameters.ball_rolling_friction,
            restitution=1.0,
        )
        inertia = (
            parameters.ball_inertia_factor * parameters.ball_mass * parameters.ball_radius**2
        )
        p.changeDynamics(
            ball_body, -1, localInertiaDiagonal=(inertia,) * 3, physicsClientId=client
        )
        head_shape = p.createCollisionShape(
            p.GEOM_BOX,
            halfExtents=tuple(0.5 * size for size in CLUB_HEAD_SIZE),
            physicsClientId=client,
        )
        head_body = self._body(
            head_shape,
            (0.0, 0.0, 100.0),
            _HEAD,
            mass=CLUB_MASS,
            restitution=parameters.club_restitution,
        )
        return ball_body, head_body

    def _box(self, box: Box, restitution: float) -> None:
        p, client = self._bullet, self._client
        shape = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=tuple(0.5 * s for s in box.size), physicsClientId=client
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
        p, client = self._bullet, self._client
        body = p.createMultiBody(
            baseMass=mass,
            baseCollisionShapeIndex=shape,
            basePosition=position,
            baseOrientation=orientation,
            physicsClientId=client,
        )
        p.changeDynamics(
            body,
            -1,
            lateralFriction=friction,
            spinningFriction=0.0,
            rollingFriction=rolling,
            restitution=restitution,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=client,
        )
        mask = _BALL if group != _BALL else _WORLD | _HEAD
        p.setCollisionFilterGroupMask(body, -1, group, mask, physicsClientId=client)
        return body
