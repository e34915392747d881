"""What an engine tells effects of the moment they act in, and what they say of themselves."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from torch import Tensor

__all__ = ["EquivalenceClass", "Excitation", "Joint", "SensorSpan", "Start"]

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
"""The experiments that reveal effects: speeds near zero; many reversals of the motion; steps of
the command; a chirp through the resonances; standing still under load; all of the range of motion
and commands; one constant speed; the same motion with an extra mass; minutes on end."""


SensorSpan = Literal["position", "rate", "joint", "positions", "rates", "all"]
"""The sensor channels that one device may have an effect on, with the same parameters: one
position, or what is no rate; one rate; a position with its rate, or a channel that stands alone;
all positions; all rates; all channels."""


@dataclass(frozen=True)
class EquivalenceClass:
    """Causes that recordings may not be able to tell apart.

    Attributes:
        name: What the class is called in reports.
        members: Ids of effects; ``"a + b"`` is a sum of effects, and a word that is no id is a
            cause outside the catalogue.
        separated_by: What would tell the members apart.
    """

    name: str
    members: tuple[str, ...]
    separated_by: str


class Start(NamedTuple):
    """What an effect's own state at the start of a segment or an episode can be made of.

    Attributes:
        time: Seconds since the rollout began, ``(N,)``.
        time_step: Seconds between two calls of the effect.
        parameters: The effect's parameters by short name.
        history: Past values that the effect asked to keep, rounded up.
        changes: By how much a sensor channel's true value differed one step before the start, two
            steps and so on, as the simulator without its effects predicts; empty for what is no
            sensor, or does not ask.
        is_rate: Whether the value is a sensor's of a velocity. Under commands that are held for a
            step, velocities are kinked where steps meet, and positions smooth.
    """

    time: Tensor
    time_step: float
    parameters: Mapping[str, Tensor]
    history: int = 0
    changes: tuple[Tensor, ...] = ()
    is_rate: bool = False

    def past(self, value: Tensor) -> tuple[Tensor, ...]:
        """Returns a sensor channel's true values before the start, latest first.

        As many as :attr:`history`.

        Args:
            value: The true value at the start.
        """
        return tuple(value + change for change in self.changes)


class Joint(NamedTuple):
    """A joint at the start of a step; tensors of the batch's shape.

    Attributes:
        position: Generalised position.
        velocity: Its rate.
        acceleration: Acceleration under the actions and all smooth forces, dry friction and the
            effects that ask for this left out.
        inverse_inertia: Acceleration per unit force at the joint, all joints free to move.
        drive: Generalised force that the drive exerts at the joint. Where the equations alone are
            known, the part that depends on the actions: a motor's torque without its back-EMF.
        takes_moments: Whether the engine moves the joint by a force's moment within a step besides
            its mean; see :meth:`ForceEffect.moment`.
    """

    position: Tensor
    velocity: Tensor
    acceleration: Tensor
    inverse_inertia: Tensor
    drive: Tensor
    takes_moments: bool = False
