"""Initial states from late or early measurements, and sensor values before a segment.

A segment starts from measured states. If a sensor lags by d, it shows the state of d seconds ago,
which is advanced by d under the recorded commands. During the first d seconds of the segment, such
a sensor still reports values from before the segment: those on the way. Computed backwards from
the segment's start, they would be useless where servos damp motions within milliseconds, because
every error would grow as fast. States are moved in time with the simulator's own accelerations at
the middle of each time span, without effects. A robot at rest at a rollout's first sample counts
as held there before, so that nothing is moved.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.language.effects import SensorEffect
from npdr_ppl.language.simulator import Simulator

__all__ = ["Accelerations", "catch_up", "changes_since", "earlier_changes", "sensor_leads"]

Accelerations = Callable[[Components, int], Components]
"""Rates of a state's velocities under the commands of a step; steps before 0 are past."""


def sensor_leads(
    effects: list[tuple[int, SensorEffect, tuple[int, ...]]],
    parameters: tuple[Mapping[str, Tensor], ...],
    time: Tensor,
) -> dict[int, Tensor]:
    """Returns the lead in seconds of sensor channels whose measurements are early or late.

    Args:
        effects: Index in ``parameters``, effect and channels.
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
    accelerations: Accelerations,
    leads: Sequence[Tensor | None],
    time_step: float,
    num_parts: int = 1,
) -> tuple[Components, tuple[Components, ...]]:
    """Returns the present state, computed from states that were measured too early or too late.

    A position whose rate is not a state stays as measured.

    Args:
        simulator: The system, whose effects are left out.
        states: Measured positions, then velocities, measured or derived from positions, ``(N,)``.
        accelerations: See :data:`Accelerations`.
        leads: Lead of each state's measurement, in seconds; negative if it is late.
        time_step: Seconds per step.
        num_parts: In how many parts a step is computed.

    Returns:
        The state, and the states one step before it, two steps before it and so on, as far as all
        measurements reach back; the last ones are the measured ones. There are none if a position
        is late and its rate is not, or the reverse: they have no common past on the way.
    """
    passed = [states]
    ages = [None if lead is None else -lead for lead in leads]
    known = [age.detach() for age in ages if age is not None]
    oldest = max((float(age.max()) for age in known), default=0.0)
    for step in range(-math.ceil(oldest / time_step), 0):
        spans = [
            None if age is None else (age + (step + 1) * time_step).clamp(0.0, time_step)
            for age in ages
        ]
        spans = [None if span is None else span / num_parts for span in spans]
        for _ in range(num_parts):
            states = _moved(simulator, states, accelerations, step, ages, spans)
            ages = [_difference(age, span) for age, span in zip(ages, spans, strict=True)]
        if step < -1:
            passed.append(states)
    if any(float(age.min()) < 0.0 for age in known):
        states = _moved(simulator, states, accelerations, 0, ages, ages)
    return states, tuple(reversed(passed)) if _are_together(simulator, leads) else ()


def _are_together(simulator: Simulator, leads: Sequence[Tensor | None]) -> bool:
    """Returns whether each rate is late or early if its position is."""
    late = {s.name: lead is not None for s, lead in zip(simulator.states, leads, strict=True)}
    rates = [state for state in simulator.states if state.rate_of in late]
    return all(late[state.name] == late[state.rate_of or ""] for state in rates)


def earlier_changes(
    simulator: Simulator,
    states: Components,
    accelerations: Accelerations,
    time_step: float,
    num_steps: int,
) -> dict[int, tuple[Tensor, ...]]:
    """Returns the differences of earlier sensor values from those at the start, latest first.

    They are zero for sensors that are not states.

    Args:
        simulator: The system, whose effects are left out.
        states: Positions, then velocities at the start, ``(N,)``.
        accelerations: See :data:`Accelerations`.
        time_step: Seconds per step.
        num_steps: Number of steps before the start.
    """
    now, none = states, [states[0].new_zeros(()) for _ in states]
    back = [value - time_step for value in none]
    earlier = []
    for step in range(1, num_steps + 1):
        now = _moved(simulator, now, accelerations, -step, none, back)
        earlier.append(now)
    return changes_since(simulator, states, earlier, num_steps)


def changes_since(
    simulator: Simulator, states: Components, earlier: Sequence[Components], num_steps: int
) -> dict[int, tuple[Tensor, ...]]:
    """Returns the differences of sensor values in earlier states, as :func:`earlier_changes` does.

    Args:
        simulator: The system.
        states: Positions, then velocities at the start, ``(N,)``.
        earlier: The same one step before, two steps before and so on. The last ones hold for all
            earlier steps.
        num_steps: Number of steps before the start.
    """
    names = [state.name for state in simulator.states]
    found = {}
    for column, sensor in enumerate(simulator.sensors):
        i = names.index(sensor.name) if sensor.name in names else None
        steps = (earlier[min(step, len(earlier) - 1)] for step in range(num_steps))
        found[column] = tuple(
            torch.zeros_like(states[0]) if i is None else values[i] - states[i] for values in steps
        )
    return found


def _moved(
    simulator: Simulator,
    states: Components,
    accelerations: Accelerations,
    step: int,
    ages: Sequence[Tensor | None],
    spans: Sequence[Tensor | None],
) -> Components:
    """Returns the states after the times ``spans``, under the commands of one step.

    Args:
        simulator: The system.
        states: The states, each at its own time.
        accelerations: See :data:`Accelerations`.
        step: The step.
        ages: Age of each state, in seconds; ``None`` for the present state.
        spans: Time by which to move each state, in seconds; ``None`` to leave it unchanged.
    """
    halves = [None if span is None else 0.5 * span for span in spans]
    middle = _under(simulator, states, accelerations(states, step), ages, halves)
    return _under(simulator, states, accelerations(middle, step), ages, spans)


def _under(
    simulator: Simulator,
    states: Components,
    accelerations: Components,
    ages: Sequence[Tensor | None],
    spans: Sequence[Tensor | None],
) -> Components:
    """Returns the states after ``spans``, under constant accelerations; see _moved."""
    result = list(states)
    places = {state.name: i for i, state in enumerate(simulator.states)}
    for j, acceleration in enumerate(accelerations, start=len(states) - len(accelerations)):
        if (span := spans[j]) is not None:
            result[j] = states[j] + span * acceleration
        i = places.get(simulator.states[j].rate_of or "")
        if i is None or (span := spans[i]) is None:
            continue
        # Uses the velocity at the end of the span; it may be known at a different time.
        velocity, position_age = result[j], _difference(ages[i], span)
        velocity_age = _difference(ages[j], spans[j])
        if position_age is not None:
            apart = position_age if velocity_age is None else position_age - velocity_age
            velocity = velocity - apart * acceleration
        result[i] = states[i] + span * velocity - 0.5 * span * span * acceleration
    return tuple(result)


def _difference(age: Tensor | None, span: Tensor | None) -> Tensor | None:
    return age if age is None or span is None else age - span
