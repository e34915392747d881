"""Domain parameters bound to a scene: dynamics, poses and gravity."""

from typing import Any

import numpy as np

from npdr_ppl.engines.bullet.channels import POSE_FIELDS, Place, parse_place
from npdr_ppl.engines.bullet.scene import Scene
from npdr_ppl.language.channels import Parameter

__all__ = ["BoundParameter"]

# Field: unit, argument of changeDynamics, index in getDynamicsInfo (None if not contained).
_DYNAMICS: dict[str, tuple[str, str, int | None]] = {
    "mass": ("kg", "mass", 0),
    "friction": ("1", "lateralFriction", 1),
    "restitution": ("1", "restitution", 5),
    "rolling_friction": ("m", "rollingFriction", 6),
    "spinning_friction": ("m", "spinningFriction", 7),
    "contact_damping": ("N s/m", "contactDamping", 8),
    "contact_stiffness": ("N/m", "contactStiffness", 9),
    "linear_damping": ("1/s", "linearDamping", None),
    "angular_damping": ("1/s", "angularDamping", None),
}
_SHIFTS = tuple(f"{field}_offset" for field in POSE_FIELDS)

_FIELDS = {
    "body": (*_DYNAMICS, *POSE_FIELDS, *_SHIFTS),
    "link": tuple(_DYNAMICS),
    "joint": ("damping",),
    "world": ("gravity",),
}


class BoundParameter:
    """A domain parameter and the quantity of a scene that it sets.

    A mass also scales the link's moments of inertia. Poses of a body are those of its centre of
    mass. An offset is added to the builder's pose; an angle offset rotates the body about axes
    through that centre that are parallel to the world's axes.

    Args:
        name: Name of the parameter.
        text: The place, e.g. ``"link lower mass"``; see
            :mod:`npdr_ppl.engines.bullet.channels`.

    Raises:
        ModelError: There is no such quantity to change.
    """

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.place: Place = parse_place(text, _FIELDS)

    def declaration(self, scene: Scene) -> Parameter:
        """Returns the parameter with its unit; its nominal value is that of the scene."""
        return Parameter(self.name, self.unit, self._present(scene), str(self.place))

    @property
    def unit(self) -> str:
        """SI unit."""
        field = self.place.field
        if self.place.kind == "joint":
            return "N m s/rad"
        if self.place.kind == "world":
            return "m/s²"
        if field in _DYNAMICS:
            return _DYNAMICS[field][0]
        return "m" if field.removesuffix("_offset") in ("x", "y", "z") else "rad"

    def apply(self, scene: Scene, value: float) -> None:
        """Sets the value in a scene."""
        client, place = scene.client, self.place
        if place.kind == "world":
            client.setGravity(0.0, 0.0, -value)
            scene.gravity = (0.0, 0.0, -value)
            return
        body, link = scene.find(place)
        if place.kind == "joint":
            client.changeDynamics(body, link, jointDamping=value)
        elif place.field in _DYNAMICS:
            if place.field == "mass":
                _set_mass(client, body, link, value)
            else:
                client.changeDynamics(body, link, **{_DYNAMICS[place.field][1]: value})
        else:
            self._move(client, body, value)

    def _present(self, scene: Scene) -> float:
        client, place = scene.client, self.place
        if place.kind == "world":
            return float(-scene.gravity[2])
        body, link = scene.find(place)
        if place.kind == "joint":
            return float(client.getJointInfo(body, link)[6])
        if place.field in _DYNAMICS:
            position = _DYNAMICS[place.field][2]
            if position is None:
                return scene.damping
            value = float(client.getDynamicsInfo(body, link)[position])
            return max(value, 0.0)  # Bullet returns -1 for a stiffness that was never set
        if place.field in _SHIFTS:
            return 0.0
        position, orientation = client.getBasePositionAndOrientation(body)
        pose = (*position, *client.getEulerFromQuaternion(orientation))
        return float(pose[POSE_FIELDS.index(place.field)])

    def _move(self, client: Any, body: int, value: float) -> None:
        """Changes the pose of a body."""
        position, orientation = client.getBasePositionAndOrientation(body)
        place = POSE_FIELDS.index(self.place.field.removesuffix("_offset"))
        if self.place.field not in _SHIFTS:
            pose = [*position, *client.getEulerFromQuaternion(orientation)]
            pose[place] = value
            position, orientation = pose[:3], client.getQuaternionFromEuler(pose[3:])
        elif place < 3:
            position = np.add(position, value * np.eye(3)[place]).tolist()
        else:
            turn = client.getQuaternionFromEuler((value * np.eye(3)[place - 3]).tolist())
            zero = (0.0, 0.0, 0.0)
            _, orientation = client.multiplyTransforms(zero, turn, zero, orientation)
        client.resetBasePositionAndOrientation(body, position, orientation)


def _set_mass(client: Any, body: int, link: int, value: float) -> None:
    """Changes a mass at constant shape: moments of inertia are scaled by the same factor.

    Otherwise, if a collision shape exists, Bullet would take the moments of that shape instead of
    the URDF's moments. Without a collision shape, it would keep the old moments.
    """
    info = client.getDynamicsInfo(body, link)
    mass, moments = info[0], info[2]
    if value == mass:
        return
    client.changeDynamics(body, link, mass=value)
    if mass > 0:
        scaled = [moment * (value / mass) for moment in moments]
        client.changeDynamics(body, link, localInertiaDiagonal=scaled)
