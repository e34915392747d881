"""Names of quantities in a scene that parameters, commands and sensors refer to.

A place is written as kind, name and quantity: ``"link lower mass"``, ``"joint elbow damping"``,
``"body ball restitution"``, ``"joint elbow position"``, ``"body ball x"``. The builder names the
bodies; joints and links are named as in the URDF. If several bodies have a joint or link of the
same name, the body's name is put in front: ``"joint left/elbow position"``.
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
    """A quantity of a joint, link, body or the world.

    Attributes:
        kind: ``"joint"``, ``"link"``, ``"body"`` or ``"world"``.
        name: Name of the joint, link or body.
        field: The quantity.
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
            step; a velocity or position is the setpoint of Bullet's joint motor.
        rated: Typical magnitude, with which effects scale their priors.
        max_force: Greatest torque or force of the motor; ``None`` for practically no limit.
        position_gain: Fraction of a position error that the motor removes per substep.
        velocity_gain: Fraction of a velocity error that the motor removes per substep.
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
            ModelError: The target is not a joint's torque, velocity or position.
        """
        parse_place(self.target, {"joint": get_args(CommandMode)})

    @cached_property
    def place(self) -> Place:
        """The target, parsed."""
        return parse_place(self.target, {"joint": get_args(CommandMode)})


@dataclass(frozen=True)
class Sensor:
    """A sensor channel and the quantity that it measures.

    Attributes:
        channel: The channel.
        source: ``"joint <name> position"`` or ``velocity``. For a body or link: its centre of
            mass ``x``, ``y``, ``z`` (m), orientation ``roll``, ``pitch``, ``yaw`` (rad), velocity
            ``vx``, ``vy``, ``vz`` (m/s) or angular velocity ``wx``, ``wy``, ``wz`` (rad/s).
        rated: Typical magnitude, with which effects scale their priors.
    """

    channel: Channel
    source: str
    rated: float = 1.0

    def __post_init__(self) -> None:
        """Checks the source.

        Raises:
            ModelError: There is no such quantity to measure.
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
        text: The text to parse.
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
    raise ModelError(f"{text!r} is no place in a scene that fits here; known are: {known}.")
