"""Data that an engine passes to effects, and types for the declarations of effects."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import torch
from torch import Tensor

__all__ = ["EquivalenceClass", "Excitation", "Joint", "SensorSpan", "Servo", "Start"]

Excitation = Literal[
    "slow_ramp",
    "reversals",
    "steps",
    "chirp",
    "hold",
    "wide_range",
    "constant_speed",
    "payload",
    "long_run",
]
"""Experiments that reveal effects, in this order: speeds near zero; many reversals of the motion;
steps of the command; a chirp through the resonances; standstill under load; the whole range of
motion and commands; one constant speed; the same motion with an extra mass; a run of minutes."""


SensorSpan = Literal["position", "rate", "joint", "positions", "rates", "all"]
"""Sensor channels that one device can affect with the same parameters, in this order: one position
or other channel that is not a rate; one rate; a position with its rate, or a channel without one;
all positions; all rates; all channels."""


@dataclass(frozen=True)
class EquivalenceClass:
    """Causes that recordings may not be able to distinguish.

    Attributes:
        name: Name of the class in reports.
        members: Ids of effects. ``"a + b"`` is a sum of effects; a word that is not an id is a
            cause outside the catalogue.
        separated_by: Experiment that distinguishes the members.
    """

    name: str
    members: tuple[str, ...]
    separated_by: str


class Start(NamedTuple):
    """Data from which an effect computes its own state at the start of a segment or an episode.

    Attributes:
        time: Seconds since the rollout began, ``(N,)``.
        time_step: Seconds between two calls of the effect.
        parameters: The effect's parameters by short name.
        history: Number of past values that the effect requested, rounded up.
        changes: Differences of a sensor channel's true value one step before the start, two
            steps before and so on, as the simulator without its effects predicts. Empty for
            effects that are not on sensors or do not request it.
        bends: Bends of the true value in the last step before the start, the one before and so
            on; see :meth:`BentSensorEffect.read_bent`. Empty for effects that do not request them.
        displacements: How far a joint moved in each interval before the start, oldest first, as
            recorded. Empty for effects that are not on joints or do not request it, and where no
            recording tells: in an episode, or if the joint's position was not measured.
        interval: Length of these intervals, in s.
    """

    time: Tensor
    time_step: float
    parameters: Mapping[str, Tensor]
    history: int = 0
    changes: tuple[Tensor, ...] = ()
    bends: tuple[Tensor, ...] = ()
    displacements: tuple[Tensor, ...] = ()
    interval: float = 0.0

    def past(self, value: Tensor) -> tuple[Tensor, ...]:
        """Returns :attr:`history` true values of a sensor channel before the start, latest first.

        Args:
            value: The true value at the start.
        """
        return tuple(value + change for change in self.changes)


class Servo(NamedTuple):
    """The quantity at a servo's port: what an effect may change of the servo.

    Attributes:
        gain: Force per unit of error, of either a position or a velocity.
        limit: Its greatest force, beside the limits that the model has; infinite without one.
    """

    gain: Tensor
    limit: Tensor = torch.tensor(math.inf, dtype=torch.float64)


class Joint(NamedTuple):
    """State of a joint at the start of a step; all tensors have the batch shape.

    Attributes:
        position: Generalised position.
        velocity: Its rate.
        acceleration: Acceleration under the actions and all smooth forces, without dry friction
            and without the effects that request this joint state.
        inverse_inertia: Acceleration per unit force at the joint, with all joints free to move.
        drive: Generalised force that the drive exerts at the joint. If only the equations are
            known, the part that depends on the actions: a motor's torque without its back-EMF.
        takes_moments: Whether the engine uses the moment of a force within a step in addition to
            its mean; see :meth:`ForceEffect.moment`.
        others: Position and velocity of the other joints with a force port, by port.
    """

    position: Tensor
    velocity: Tensor
    acceleration: Tensor
    inverse_inertia: Tensor
    drive: Tensor
    takes_moments: bool = False
    others: Mapping[str, tuple[Tensor, Tensor]] = MappingProxyType({})
