"""Declarations of a simulator: channels, parameters and ports, each with a unit."""

import math
from dataclasses import dataclass
from difflib import get_close_matches
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import ModelError

__all__ = ["Channel", "Follower", "Parameter", "Port", "PortKind", "Spin"]

PortKind = Literal["force", "action", "servo", "sensor", "environment", "clock", "parameter"]

_GROUPED = {"sensor", "action", "servo"}


@dataclass(frozen=True)
class Channel:
    """One column of a trajectory: a state, a measurement or an action.

    Attributes:
        name: Name as in data files, e.g. ``"arm_angle"``.
        unit: SI unit, e.g. ``"rad/s"``.
        lower: Least possible value, in ``unit``.
        upper: Greatest possible value, in ``unit``.
        rate_of: Name of the channel whose time derivative this one is. With it, the state at a
            segment's start can be estimated from position measurements alone.
    """

    name: str
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    rate_of: str | None = None


@dataclass(frozen=True)
class Follower:
    """A position that follows from another one, such as that of the second finger of a gripper.

    Attributes:
        name: The state that follows.
        leader: The state it follows from.
        coefficients: Coefficients of the polynomial of the leader that it is, the constant first.
        unit: Empty: it is that of the leader.
    """

    unit: ClassVar[str] = ""
    name: str
    leader: str
    coefficients: tuple[float, ...]

    @property
    def leaders(self) -> tuple[str, ...]:
        """All states that it follows from."""
        return (self.leader,)

    def follow(self, values: NDArray[np.float64], time_step: float) -> NDArray[np.float64]:
        """Returns its values, ``(T,)``.

        Args:
            values: Values of the leaders, ``(T, 1)``.
            time_step: Seconds between them.
        """
        return np.polynomial.Polynomial(self.coefficients)(values[:, 0])


@dataclass(frozen=True)
class Spin:
    """An angular velocity about an axis of a floating body, which follows from its orientation.

    Attributes:
        name: The state that follows.
        axis: Number of the body's axis.
        leaders: The states w, x, y and z of the quaternion from the body's frame to the world's.
        unit: Its unit.
    """

    unit: ClassVar[str] = "rad/s"
    name: str
    axis: int
    leaders: tuple[str, str, str, str]

    @property
    def leader(self) -> str:
        """The first state that it follows from."""
        return self.leaders[0]

    def follow(self, values: NDArray[np.float64], time_step: float) -> NDArray[np.float64]:
        """Returns the angular velocity between the samples before and after each, ``(T,)``.

        Args:
            values: The quaternions, ``(T, 4)``, each with either sign.
            time_step: Seconds between them.
        """
        places = np.arange(len(values))
        before, after = np.maximum(places - 1, 0), np.minimum(places + 1, len(values) - 1)
        one, other = values[before], values[after]
        # The turn from one to the other in the body's frame, conj(one) other.
        w = (one * other).sum(1)
        turn = (
            one[:, :1] * other[:, 1:]
            - other[:, :1] * one[:, 1:]
            - np.cross(one[:, 1:], other[:, 1:])
        )
        size = np.linalg.norm(turn, axis=1)
        turn *= np.sign(w)[:, None]
        angle = 2.0 * np.arctan2(size, np.abs(w))
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(size > 0.0, turn[:, self.axis] / size, 0.0)
        share = np.where(np.isnan(size), np.nan, share)
        return angle * share / (time_step * np.maximum(after - before, 1))


@dataclass(frozen=True)
class Parameter:
    """A domain parameter of a simulator or an effect.

    Attributes:
        name: Name as it appears as a sample site, e.g. ``"pole_mass"``.
        unit: SI unit, ``"1"`` if it has none.
        nominal: Data-sheet value, in ``unit``.
        description: Short description for tables.
    """

    name: str
    unit: str
    nominal: float
    description: str = ""


@dataclass(frozen=True)
class Port:
    """A place in a simulator where effects attach.

    Attributes:
        name: Name in sites and JSON. For a group of channels that one device measures, or whose
            commands one device sends, their names joined by commas:
            ``"arm_velocity,pole_velocity"``.
        kind: Quantity at the port: a generalised force at a joint, an action before it reaches
            the dynamics, the position or velocity that a servo is to reach, a measurement, a
            quantity of the environment, the clock that stamps all measurements, or a domain
            parameter.
        unit: SI unit of the quantity.
        rated: Typical magnitude, in ``unit``; effects scale their priors by it.
        rated_speed: Typical speed of a joint that a force or a servo acts on, in its coordinate
            per second.
        rated_position: Typical excursion of such a joint, in its coordinate; of a mass, the
            length of what carries it.
        coordinate: Unit of the position of a joint that a force or a servo acts on: ``"rad"`` for
            a revolute, ``"m"`` for a prismatic joint, and for a mass that can be anywhere on its
            body.
        rated_force: Typical force of a servo, in :attr:`force_unit`.
        joint: Name of the port of the force at the joint that a servo moves; empty if there is
            none.
        is_driven: Whether an actuator drives the joint that a force acts on.
        is_floating: Whether a force acts along, or a torque about, an axis of a floating body.
            Such an axis has a velocity, but no position, and no bearing in which it rubs.
    """

    name: str
    kind: PortKind
    unit: str
    rated: float = 1.0
    rated_speed: float = 1.0
    rated_position: float = 1.0
    coordinate: str = "rad"
    is_driven: bool = True
    rated_force: float = 1.0
    joint: str = ""
    is_floating: bool = False

    @property
    def follows_position(self) -> bool:
        """Whether the goal of a servo is the position of its joint."""
        return self.kind == "servo" and self.unit == self.coordinate

    @property
    def force_unit(self) -> str:
        """Unit of the force at a joint: N m or N."""
        return "N m" if self.coordinate == "rad" else "N"

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that the port covers."""
        return tuple(self.name.split(","))


def find_port(ports: tuple[Port, ...], name: str, simulator_name: str) -> Port:
    """Returns the port called ``name``; groups of ports of one kind are formed on demand.

    Groups are formed of sensors, of actions, and of servos.

    Raises:
        ModelError: There is no such port, or the group mixes kinds.
    """
    by_name = {port.name: port for port in ports}
    if name in by_name:
        return by_name[name]
    members = [by_name[part] for part in name.split(",") if part in by_name]
    kinds = {port.kind for port in members}
    if len(members) == len(name.split(",")) and len(kinds) == 1 and kinds < _GROUPED:
        return Port(name, members[0].kind, members[0].unit, max(port.rated for port in members))
    close = get_close_matches(name, by_name, n=1)
    raise ModelError(
        f"{simulator_name} has no port {name!r}; "
        f"{f'did you mean {close[0]!r}? Its' if close else 'its'} ports are "
        f"{', '.join(sorted(by_name)) or '(none)'}."
    )
