"""Readings that are late or early: the state behind them at the start of a segment.

A segment starts from what was read there. If the sensors lag by d, that is the state d ago, and
the segment starts from the state extrapolated over d with the simulator's own accelerations. That
is exact to second order in d for positions and to first order for velocities, under the command
that was given last.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from npdr_ppl.engines.integrators import Components
from npdr_ppl.language.effects import SensorEffect

if TYPE_CHECKING:
    from npdr_ppl.engines.ode import ODESimulator

__all__ = ["catch_up", "sensor_leads", "sensor_rates"]


def sensor_rates(
    simulator: "ODESimulator",
    positions: Components,
    velocities: Components,
    actions: Components,
    constants: Any,
) -> dict[int, tuple[Tensor, ...]]:
    """Returns first and second derivative of the sensor channels, zero unless they read states.

    Args:
        simulator: The system, whose effects are left out.
        positions: Positions, ``(N,)`` each.
        velocities: Velocities, ``(N,)`` each.
        actions: What each action channel saw last, ``(N,)`` each.
        constants: The system's constants.
    """
    zero = torch.zeros_like(positions[0])
    accelerations = _accelerations(simulator, positions, velocities, actions, constants)
    derivatives = [
        *zip(velocities, accelerations, strict=True),
        *((acceleration, zero) for acceleration in accelerations),
    ]
    names = (state.name for state in simulator.states)
    by_name = dict(zip(names, derivatives, strict=True))
    return {
        column: by_name.get(sensor.name, (zero, zero))
        for column, sensor in enumerate(simulator.sensors)
    }


def sensor_leads(
    effects: list[tuple[int, SensorEffect, tuple[int, ...]]],
    parameters: tuple[Mapping[str, Tensor], ...],
    time: Tensor,
) -> dict[int, Tensor]:
    """Returns by how many seconds each sensor channel's readings are ahead, where they are.

    Args:
        effects: Place in ``parameters``, effect and channels.
        parameters: Parameters of all effects by short name.
        time: Seconds since the rollout began, ``(N,)``.
    """
    leads: dict[int, Tensor] = {}
    for place, effect, columns in effects:
        lead = effect.lead(parameters[place], time)
        if lead is not None:
            leads |= {column: leads.get(column, 0.0) + lead for column in columns}
    return leads


def catch_up(
    simulator: "ODESimulator",
    positions: Components,
    velocities: Components,
    actions: Components,
    constants: Any,
    leads: tuple[Tensor | None, ...],
) -> tuple[Components, Components]:
    """Returns the state now behind one that was read too early or too late.

    Args:
        simulator: The system, whose effects are left out.
        positions: Positions as read, ``(N,)`` each.
        velocities: Velocities as read, or derived from positions, ``(N,)`` each.
        actions: What each action channel saw last, ``(N,)`` each.
        constants: The system's constants.
        leads: By how many seconds each position, then each velocity is ahead.
    """
    accelerations = _accelerations(simulator, positions, velocities, actions, constants)
    q, v = list(positions), list(velocities)
    for i, acceleration in enumerate(accelerations):
        lead, rate_lead = leads[i], leads[len(q) + i]
        if rate_lead is not None:
            v[i] = velocities[i] - rate_lead * acceleration
        if lead is not None:
            # Back from the velocity now, which has just been found.
            q[i] = positions[i] - lead * v[i] - 0.5 * lead * lead * acceleration
    return tuple(q), tuple(v)


def _accelerations(
    simulator: "ODESimulator",
    positions: Components,
    velocities: Components,
    actions: Components,
    constants: Any,
) -> Components:
    none = (0.0,) * len(positions)
    return simulator.accelerations(positions, velocities, actions, none, constants)
