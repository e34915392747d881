"""Words for places in a scene: what parameters, commands and sensors are bound to.

A place is written as its kind, its name and what of it is meant: ``"link lower mass"``,
``"joint elbow damping"``, ``"body ball restitution"``, ``"joint elbow position"``, ``"body ball
x"``. Bodies are named by the builder, joints and links as in the URDF; where several bodies have
one of the same name, the body's goes in front: ``"joint left/elbow position"``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel

__all__ = ["Command", "CommandMode", "Place", "Sensor", "parse_place"]

CommandMode = Literal["torque", "velocity", "position"]

POSE_FIELDS = ("x", "y", "z", "roll", "pitch", "yaw")
RATE_FIELDS = ("vx", "vy", "vz", "wx", "wy", "wz")
JOINT_FIELDS = ("position", "velocity")


@dataclass(frozen=True)
class Place:
    """A place in a scene.

    Attributes:
        kind: ``"joint"``, ``"link"``, ``"body"`` or ``"world"``.
        name: Name of the joint, link or body.
        field: What of it is meant.
    """

    kind: str
    name: str
    field: str

    def __str__(self) -> str:
        return " ".join(part for part in (self.kind, self.name, self.field) if part)


@dataclass(frozen=True)
class Command:
    """An action channel and the joint it commands.

    Attributes:
        channel: The channel; its bounds limit the command.
        target: ``"joint <name> torque"``, ``velocity`` or ``position``. A torque is held during a
            step; velocity and position are what Bullet's motor of the joint aims at.
        rated: Typical magnitude, by which effects scale their priors.
        max_force: Greatest torque or force of the motor; ``None`` for no limit to speak of.
        position_gain: Share of a position error that the motor removes per substep.
        velocity_gain: Share of a velocity error that the motor removes per substep.
    """

    channel: Channel
    target: str
    rated: float = 1.0
    max_force: float | None = None
    position_gain: float = 0.1
    velocity_gain: float = 1.0

    def __post_init__(self) -> None:
        """Checks the target.

        Raises:
            ModelError: It is not a joint's torque, velocity or position.
        """
        parse_place(self.target, {"joint": get_args(CommandMode)})

    @cached_property
    def place(self) -> Place:
        """The target, parsed."""
        return parse_place(self.target, {"joint": get_args(CommandMode)})


@dataclass(frozen=True)
class Sensor:
    """A sensor channel and what it reads.

    Attributes:
        channel: The channel.
        source: ``"joint <name> position"`` or ``velocity``; or of a body or link its centre of
            mass ``x``, ``y``, ``z`` (m), orientation ``roll``, ``pitch``, ``yaw`` (rad), velocity
            ``vx``, ``vy``, ``vz`` (m/s) or angular velocity ``wx``, ``wy``, ``wz`` (rad/s).
        rated: Typical magnitude, by which effects scale their priors.
    """

    channel: Channel
    source: str
    rated: float = 1.0

    def __post_init__(self) -> None:
        """Checks the source.

        Raises:
            ModelError: There is nothing like it to read.
        """
        parse_place(self.source, _SENSOR_FIELDS)

    @cached_property
    def place(self) -> Place:
        """The source, parsed."""
        return parse_place(self.source, _SENSOR_FIELDS)


_SENSOR_FIELDS = {
    "joint": JOINT_FIELDS,
    "body": POSE_FIELDS + RATE_FIELDS,
    "link": POSE_FIELDS + RATE_FIELDS,
}


def parse_place(text: str, fields: Mapping[str, tuple[str, ...]]) -> Place:
    """Parses ``"<kind> <name> <field>"``; the world has no name.

    Args:
        text: The words.
        fields: Possible fields by kind.

    Raises:
        ModelError: There is no such kind or field.
    """
    kind, _, rest = text.strip().partition(" ")
    for field in sorted(fields.get(kind, ()), key=len, reverse=True):
        if kind == "world" and rest == field:
            return Place(kind, "", field)
        if kind != "world" and rest.endswith(f" {field}"):
            return Place(kind, rest.removesuffix(field).strip(), field)
    known = "; ".join(
        f"{kind}{'' if kind == 'world' else ' <name>'} {' | '.join(names)}"
        for kind, names in fields.items()
    )
    raise ModelError(f"{text!r} is no place in a scene that would do here; known are: {known}.")
