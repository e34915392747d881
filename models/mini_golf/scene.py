"""The mini-golf course in PyBullet, and one strike on it.

How contacts are solved is part of the model, so it is fixed here:

* four sub-steps of 2.5 ms per sample and 20 solver iterations;
* Bullet combines restitutions, frictions and rolling frictions of two bodies as it does by
  default: the products of restitutions and of frictions, and for rolling the sum of each body's
  rolling friction (m) times the other's friction;
* the head collides only with the ball, and all other bodies collide only with the ball;
* a contact exists below a distance of 10 µm, and overlaps are not pushed apart by springs (contact
  ERP 0). With Bullet's default of 2 cm, contacts are predicted one ball radius ahead and suppress
  the rebound. The threshold belongs to the process and survives a reset, so every strike sets it;
* no damping in the air, and the bodies never sleep.

Two choices save computing time. Fixed bodies are kept in maximal coordinates, because Bullet
updates every body in reduced coordinates at every sub-step, even fixed ones. While the club is out
of reach, one call of Bullet makes all sub-steps of a step. Neither changes the physics; the first
changes rounding, which contacts amplify.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.engines.bullet.client import connect
from npdr_ppl.engines.bullet.settings import BulletSettings
from npdr_ppl.models.mini_golf.clubs import Club
from npdr_ppl.models.mini_golf.course import (
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

__all__ = ["GRAVITY", "SETTINGS", "SUB_STEPS", "Scene"]

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

REACH = 0.1
"""Distance in m of ball and club head beyond which the head is not moved. The ball has a radius of
at most 2.6 cm and the head a half-diagonal of 3.7 cm. Neither moves much faster than 2 m/s, or 2
cm per step."""

REST_SPEED = 1e-4
"""Speed in m/s, also of the surface, below which a ball counts as at rest if nothing will push it.
Rolling friction then stops it within a micrometre."""

STEPS_PER_REST_CHECK = 10

_BALL, _WORLD, _HEAD = 1, 2, 4
"""Collision groups; the ball collides with both others, which do not collide with each other."""


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
        self, parameters: StrikeParameters, ball: Array, club: Club, time_step: float
    ) -> Array:
        """Simulates one strike.

        Args:
            parameters: The course and the ball.
            ball: Initial position of the ball in m, ``(2,)``.
            club: The striker, with its path over K steps.
            time_step: Seconds per step.

        Returns:
            The ball's x and y after each step in m, ``(K, 2)``.
        """
        client = self._client
        self._build_course(parameters)
        self._set_step(time_step, SUB_STEPS, is_one_call=False)
        ball_body = self._add_ball(parameters, ball)
        club_body, head = club.build(client, parameters.club_restitution)
        client.setCollisionFilterGroupMask(club_body, head, _HEAD, _BALL)
        locate, step_simulation = client.getBasePositionAndOrientation, client.stepSimulation
        follow = club.follower(client, club_body)
        track = club.ground_track
        result = np.empty((len(track), 2))
        (x, y, _), _ = locate(ball_body)
        is_near = True
        for step, (head_x, head_y) in enumerate(track.tolist()):
            was_near = is_near
            is_near = (head_x - x) ** 2 + (head_y - y) ** 2 < REACH**2
            if was_near and not is_near:
                club.put_aside(client, club_body)
            if was_near is not is_near:
                self._set_step(time_step, SUB_STEPS, is_one_call=not is_near)
            if is_near:
                for k in range(step * SUB_STEPS, (step + 1) * SUB_STEPS):
                    follow(k)
                    step_simulation()
            else:
                step_simulation()
            (x, y, _), _ = locate(ball_body)
            result[step] = x, y
            if is_near or step % STEPS_PER_REST_CHECK:
                continue
            if not self._is_at_rest(ball_body, parameters.ball_radius):
                continue
            if np.linalg.norm(track[step:] - (x, y), axis=-1).min() > REACH:
                result[step:] = x, y
                break
        return result

    def _is_at_rest(self, ball: int, radius: float) -> bool:
        linear, angular = self._client.getBaseVelocity(ball)
        return max(*map(abs, linear), radius * max(map(abs, angular))) < REST_SPEED

    def _set_step(self, time_step: float, sub_steps: int, *, is_one_call: bool) -> None:
        """Sets the sub-steps' length, and whether a call makes one sub-step or all of a step."""
        client = self._client
        # Survives a reset, so every strike sets it.
        client.setPhysicsEngineParameter(numSubSteps=sub_steps if is_one_call else 0)
        client.setTimeStep(time_step if is_one_call else time_step / sub_steps)

    def _build_course(self, parameters: StrikeParameters) -> None:
        client = self._client
        client.resetSimulation()
        client.setPhysicsEngineParameter(enableFileCaching=0, **SETTINGS.engine_parameters())
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

    def _add_ball(self, parameters: StrikeParameters, place: Array) -> int:
        client = self._client
        radius, mass = parameters.ball_radius, parameters.ball_mass
        body = self._body(
            client.createCollisionShape(client.GEOM_SPHERE, radius=radius),
            (float(place[0]), float(place[1]), radius),
            _BALL,
            mass=mass,
            friction=parameters.ball_friction,
            rolling=parameters.ball_rolling_friction,
            restitution=1.0,
        )
        inertia = parameters.ball_inertia_factor * mass * radius**2
        client.changeDynamics(body, -1, localInertiaDiagonal=(inertia,) * 3)
        return body

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
            useMaximalCoordinates=int(mass == 0.0),
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
