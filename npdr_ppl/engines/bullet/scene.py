"""Access to the bodies, joints and links of a scene by name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from os import PathLike
from pathlib import Path
from typing import Any

from npdr_ppl.engines.bullet.channels import (
    JOINT_FIELDS,
    POSE_FIELDS,
    RATE_FIELDS,
    Place,
    Sensor,
)
from npdr_ppl.engines.bullet.settings import BulletSettings
from npdr_ppl.engines.common.robot_files import read_robot
from npdr_ppl.errors import ModelError

__all__ = ["Builder", "Scene", "Urdf"]

Builder = Callable[[Any, Mapping[str, float]], Mapping[str, int]]
"""Builds a scene in an empty world: takes PyBullet's client and the parameters by name, returns
body ids by name."""


@dataclass(frozen=True)
class Urdf:
    """Builds a scene of one robot from a URDF file.

    Inertias are those of the file; PyBullet's default is to compute them from collision shapes.

    Attributes:
        path: The file; workers must find it at the same path.
        name: Name of the body.
        is_fixed: Whether the base is fixed to the world.
        position: Position of the base, in metres.
    """

    path: str | PathLike[str]
    name: str = "robot"
    is_fixed: bool = True
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __call__(self, client: Any, parameters: Mapping[str, float]) -> dict[str, int]:
        """Loads the file."""
        path = Path(self.path)
        if not path.is_file():
            raise ModelError(f"{path} does not exist.")
        read_robot(path)
        try:
            body = client.loadURDF(
                str(path),
                basePosition=self.position,
                useFixedBase=self.is_fixed,
                flags=client.URDF_USE_INERTIA_FROM_FILE,
            )
        except Exception as error:  # PyBullet exports no class for its error
            raise ModelError(f"{path} is not a URDF file that Bullet can load.") from error
        return {self.name: body}


class Scene:
    """A world with all its bodies.

    Bullet's default joint motors are switched off, and the settings define the damping of bodies.
    Only requested forces act.

    Args:
        client: PyBullet's client.
        build: Builds the bodies in the world.
        parameters: The parameters by name, for the builder.
        settings: Settings of the engine.
        time_step: Seconds per step, substeps included.

    Attributes:
        client: PyBullet's client.
        bodies: Ids by name.
        joints: Body and index of each joint that moves, by name.
        links: Body and index of each link, by name; a body's base has the index -1.
        gravity: Acceleration of gravity, in m/s².
        damping: Damping of bodies, in 1/s.
    """

    def __init__(
        self,
        client: Any,
        build: Builder,
        parameters: Mapping[str, float],
        settings: BulletSettings,
        time_step: float,
    ) -> None:
        self.client = client
        self.gravity = settings.gravity
        self.damping = settings.damping
        client.resetSimulation()
        client.setPhysicsEngineParameter(**settings.engine_parameters())
        client.setTimeStep(time_step / settings.substeps)
        client.setGravity(*settings.gravity)
        self.bodies = dict(build(client, parameters))
        self.joints: dict[str, tuple[int, int]] = {}
        self.links: dict[str, tuple[int, int]] = {}
        self._ambiguous: set[str] = set()
        for name, body in self.bodies.items():
            self._index(name, body)

    def find(self, place: Place) -> tuple[int, int]:
        """Returns body and index of a joint, link or body.

        Raises:
            ModelError: None or several have that name.
        """
        if place.kind == "body":
            known = {name: (body, -1) for name, body in self.bodies.items()}
        else:
            known = self.joints if place.kind == "joint" else self.links
        if place.name in known:
            return known[place.name]
        if place.name in self._ambiguous:
            raise ModelError(
                f"Several bodies have a {place.kind} {place.name!r}; put the body's name in "
                f"front, as in {next(iter(self.bodies))}/{place.name}."
            )
        raise ModelError(
            f"The scene has no {place.kind} {place.name!r}; it has "
            f"{', '.join(sorted(known)) or 'none'}."
        )

    def reader(self, sensors: Sequence[Sensor]) -> Callable[[], Sequence[float]]:
        """Returns a function that reads sensors in the present state of the world.

        Each function of Bullet is called once, even if several sensors use its result.
        """
        sources: dict[Any, Callable[[], Any]] = {}
        columns = []
        for sensor in sensors:
            key, column, function = self._source(sensor.place)
            sources.setdefault(key, function)
            columns.append((list(sources).index(key), column))
        functions = list(sources.values())
        if len(functions) == 1 and len(columns) > 1:  # e.g. a joint's position and velocity
            (function,) = functions
            chosen = itemgetter(*(column for _, column in columns))
            return lambda: chosen(function())

        def read() -> list[float]:
            seen = [function() for function in functions]
            return [seen[source][column] for source, column in columns]

        return read

    def place_joint(self, joint: tuple[int, int], position: float, velocity: float) -> None:
        """Sets the state of a joint."""
        self.client.resetJointState(*joint, position, velocity)

    def place_body(self, body: int, values: Mapping[str, float]) -> None:
        """Sets pose and velocity of a body's base; fields that are not given stay unchanged.

        Args:
            body: Its id.
            values: Values by field: ``x`` … ``yaw``, ``vx`` … ``wz``.
        """
        client = self.client
        position, orientation = client.getBasePositionAndOrientation(body)
        pose = dict(
            zip(
                POSE_FIELDS,
                (*position, *client.getEulerFromQuaternion(orientation)),
                strict=True,
            )
        )
        rates = dict(zip(RATE_FIELDS, sum(client.getBaseVelocity(body), ()), strict=True))
        if any(field in values for field in POSE_FIELDS):
            pose |= {field: values[field] for field in POSE_FIELDS if field in values}
            if any(field in values for field in POSE_FIELDS[3:]):
                orientation = client.getQuaternionFromEuler([pose[f] for f in POSE_FIELDS[3:]])
            client.resetBasePositionAndOrientation(
                body, [pose[f] for f in POSE_FIELDS[:3]], orientation
            )
        rates |= {field: values[field] for field in RATE_FIELDS if field in values}
        # Moving a body sets its velocity to zero, so the velocity is set last.
        client.resetBaseVelocity(
            body, [rates[f] for f in RATE_FIELDS[:3]], [rates[f] for f in RATE_FIELDS[3:]]
        )

    def _index(self, name: str, body: int) -> None:
        """Records a body's joints and links, and makes them passive."""
        client = self.client
        client.changeDynamics(body, -1, linearDamping=self.damping, angularDamping=self.damping)
        base = client.getBodyInfo(body)[0].decode()
        self._note(self.links, name, base, (body, -1))
        for index in range(client.getNumJoints(body)):
            info = client.getJointInfo(body, index)
            client.changeDynamics(
                body, index, linearDamping=self.damping, angularDamping=self.damping
            )
            self._note(self.links, name, info[12].decode(), (body, index))
            if info[2] in (client.JOINT_REVOLUTE, client.JOINT_PRISMATIC):
                self._note(self.joints, name, info[1].decode(), (body, index))
                client.setJointMotorControl2(body, index, client.VELOCITY_CONTROL, force=0.0)

    def _note(
        self, table: dict[str, tuple[int, int]], body: str, name: str, value: tuple[int, int]
    ) -> None:
        table[f"{body}/{name}"] = value
        if name in table:
            del table[name]
            self._ambiguous.add(name)
        elif name not in self._ambiguous:
            table[name] = value

    def _source(self, place: Place) -> tuple[Any, int, Callable[[], Any]]:
        """Returns the key of a function, the column of the place in its result, the function."""
        client = self.client
        body, index = self.find(place)
        if place.kind == "joint":
            column = JOINT_FIELDS.index(place.field)
            return ("joint", body, index), column, partial(client.getJointState, body, index)
        pose, rate = self._motion(body, index)
        is_rate = place.field in RATE_FIELDS
        part, column = divmod((RATE_FIELDS if is_rate else POSE_FIELDS).index(place.field), 3)
        key = "rate" if is_rate else "pose", body, index, part
        if is_rate:
            return key, column, lambda: rate()[part]
        if part == 0:
            return key, column, lambda: pose()[0]
        to_angles = client.getEulerFromQuaternion
        return key, column, lambda: to_angles(pose()[1])

    def _motion(self, body: int, index: int) -> tuple[Callable[[], Any], Callable[[], Any]]:
        """Returns functions that read a link's pose and its velocities."""
        client = self.client
        if index == -1:
            return (
                partial(client.getBasePositionAndOrientation, body),
                partial(client.getBaseVelocity, body),
            )
        link_state = client.getLinkState
        return (
            lambda: link_state(body, index, computeForwardKinematics=1)[:2],
            lambda: link_state(body, index, computeLinkVelocity=1)[6:8],
        )
