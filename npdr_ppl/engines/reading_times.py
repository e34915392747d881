"""Readings that are late or early: the state behind them at the start of a segment.

A segment starts from what was read there. If the sensors lag by d, that is the state d ago, and
the segment starts from the state extrapolated over d with the simulator's own accelerations
halfway there. That is exact to second order in d while the command stays the same.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.integrators import Components
from npdr_ppl.language.effects import SensorEffect
from npdr_ppl.language.simulator import Simulator

__all__ = ["catch_up", "sensor_leads", "sensor_rates"]


def sensor_rates(
    simulator: Simulator, velocities: Components, accelerations: Components
) -> dict[int, tuple[Tensor, ...]]:
    """Returns first and second derivative of the sensor channels, zero unless they read states.

    A position's first derivative is the velocity that is declared as its rate.

    Args:
        simulator: The system, whose effects are left out.
        velocities: Velocities among its states, ``(N,)`` each.
        accelerations: Their rates.
    """
    num_positions = len(simulator.states) - len(velocities)
    by_name: dict[str, tuple[Tensor, ...]] = {}
    for state, velocity, acceleration in zip(
        simulator.states[num_positions:], velocities, accelerations, strict=True
    ):
        by_name[state.name] = acceleration, torch.zeros_like(velocity)
        if state.rate_of is not None:
            by_name[state.rate_of] = velocity, acceleration
    none = tuple(torch.zeros_like(v) for v in (*velocities, *velocities)[:2])
    return {
        column: by_name.get(sensor.name, none) for column, sensor in enumerate(simulator.sensors)
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
    simulator: Simulator,
    states: Components,
    accelerations: Callable[[Components], Components],
    leads: tuple[Tensor | None, ...],
) -> Components:
    """Returns the state now behind one that was read too early or too late.

    A position whose rate is no state stays as it was read.

    Args:
        simulator: The system, whose effects are left out.
        states: Positions as read, then velocities as read or derived from positions, ``(N,)``.
        accelerations: Returns the rates of the velocities in a state, ``(N,)`` each.
        leads: By how many seconds each state's reading is ahead.
    """
    halfway = tuple(None if lead is None else 0.5 * lead for lead in leads)
    middle = _earlier(simulator, states, accelerations(states), halfway)
    return _earlier(simulator, states, accelerations(middle), leads)


def _earlier(
    simulator: Simulator,
    states: Components,
    accelerations: Components,
    times: tuple[Tensor | None, ...],
) -> Components:
    """Returns the states so many seconds earlier, under constant accelerations."""
    result = list(states)
    num_positions = len(states) - len(accelerations)
    places = {state.name: i for i, state in enumerate(simulator.states)}
    for j, acceleration in enumerate(accelerations, start=num_positions):
        rate_time = times[j]
        if rate_time is not None:
            result[j] = states[j] - rate_time * acceleration
        i = places.get(simulator.states[j].rate_of or "")
        time = None if i is None else times[i]
        if i is not None and time is not None:
            # Back from the velocity then, which has just been found.
            result[i] = states[i] - time * result[j] - 0.5 * time * time * acceleration
    return tuple(result)
