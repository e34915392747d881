"""What a chain of effects passes from step to step, and what stays constant meanwhile."""

from typing import Any, NamedTuple

from torch import Tensor

from npdr_ppl.engines.common.integrators import Components

__all__ = ["Moments", "State", "Tables", "add_to"]


Moments = tuple[Tensor | None, ...]
"""First moment of each action about a step's middle; ``None`` for a constant action."""


class State(NamedTuple):
    """Data that the next step needs; every tensor has the flat batch shape ``(N,)``.

    Attributes:
        positions: Generalised positions.
        velocities: Generalised velocities.
        force_memory: Own state of each force effect.
        action_memory: Own state of each action effect.
        past_commands: Past commands that each action effect may need, latest first.
        sensor_memory: Own state of each sensor effect for each of its channels.
        past_readings: True sensor values at the state's time and one step earlier; empty without
            a :class:`~npdr_ppl.language.effects.BentSensorEffect`.
        servo_memory: Own state of each effect inside a servo.
    """

    positions: Components
    velocities: Components
    force_memory: tuple[Any, ...] = ()
    action_memory: tuple[Any, ...] = ()
    past_commands: tuple[Components, ...] = ()
    sensor_memory: tuple[tuple[Any, ...], ...] = ()
    past_readings: tuple[Components, ...] = ()
    servo_memory: tuple[Tensor | None, ...] = ()


class Tables(NamedTuple):
    """Data that stay constant during a simulation.

    Attributes:
        constants: The model author's constants.
        effects: Parameters of each effect by short name, in the order of attachment.
    """

    constants: Any
    effects: tuple[dict[str, Tensor], ...]


def add_to(totals: list[Tensor | None], place: int, part: Tensor | None) -> None:
    """Adds to a total; ``None`` counts as zero and needs no operation."""
    total = totals[place]
    if part is not None:
        totals[place] = part if total is None else total + part
