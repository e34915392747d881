"""Initial states from late or early measurements, and sensor values before a segment.

A segment starts from measured states. If a sensor lags by d, it shows the state of d seconds ago,
which is advanced by d under the recorded commands. During the first d seconds of the segment, such
a sensor still reports values from before the segment: those on the way. Where only one of a
position and its rate is late, and in episodes, they are computed backwards from the start instead.
This is useless where servos damp motions within milliseconds, because every error grows as fast.
States are moved in time with the simulator's own accelerations at the middle of each time span,
without effects. A robot at rest at a rollout's first sample counts as held there before, so that
nothing is moved.
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
    *,
    num_parts: int = 1,
    num_before: int = 0,
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
        num_before: How many earlier states are wanted.

    Returns:
        The state, and the states one step before it, two steps before it and so on. Before the
        measured states, and for components that are not late, they are extrapolated. Empty if only
        one of a position and its rate is late.
    """
    measured, passed = states, []
    ages = [None if lead is None else -lead for lead in leads]
    known = [age.detach() for age in ages if age is not None]
    oldest = max((float(age.max()) for age in known), default=0.0)
    first = -math.ceil(oldest / time_step)
    for step in range(first, 0):
        spans = [
            None if age is None else (age + (step + 1) * time_step).clamp(0.0, time_step)
            for age in ages
        ]
        spans = [None if span is None else span / num_parts for span in spans]
        for _ in range(num_parts):
            states = _moved(simulator, states, accelerations, step, ages, spans)
            ages = [_difference(age, span) for age, span in zip(ages, spans, strict=True)]
        if step < -1:
            passed.insert(0, states)
    if any(float(age.min()) < 0.0 for age in known):
        states = _moved(simulator, states, accelerations, 0, ages, ages)
    if not num_before or not _are_together(simulator, leads):
        return states, ()
    # Where damping is too fast for whole steps, an extrapolation along a line is more accurate.
    curved = (lambda values, step: ()) if num_parts > 1 else accelerations
    before_start = _extrapolation(simulator, states, curved(states, -1))
    before_measured = _extrapolation(simulator, measured, curved(measured, min(first, -1)))
    late = [None if lead is None else (-lead).clamp_min(0.0) for lead in leads]
    earlier = []
    for number in range(1, num_before + 1):
        before = number * time_step
        values = []
        for i, age in enumerate(late):
            value = before_start(i, states[i].new_tensor(before))
            if age is not None:
                value = torch.where(age > 0.0, before_measured(i, before - age), value)
                if number <= len(passed):
                    value = torch.where(age > before, passed[number - 1][i], value)
            values.append(value)
        earlier.append(tuple(values))
    return states, tuple(earlier)


def _extrapolation(
    simulator: Simulator, states: Components, accelerations: Components
) -> Callable[[int, Tensor], Tensor]:
    """Returns a function of the number of a component and of a time: its value that long before.

    Args:
        simulator: The system.
        states: Positions, then velocities.
        accelerations: Rates of the velocities, constant over that time; empty for zero.
    """
    places = {state.name: i for i, state in enumerate(simulator.states)}
    rate_of = {places.get(s.rate_of or ""): j for j, s in enumerate(simulator.states)}
    by_state = dict(enumerate(accelerations, start=len(states) - len(accelerations)))

    def value(number: int, time: Tensor) -> Tensor:
        if number in by_state:
            return states[number] - time * by_state[number]
        rate = rate_of.get(number)
        if rate is None:
            return states[number] + torch.zeros_like(time)
        moved = states[number] - time * states[rate]
        return moved + 0.5 * time**2 * by_state[rate] if rate in by_state else moved

    return value


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
    return changes_since(simulator, states, earlier)


def changes_since(
    simulator: Simulator, states: Components, earlier: Sequence[Components]
) -> dict[int, tuple[Tensor, ...]]:
    """Returns the differences of sensor values in earlier states, as :func:`earlier_changes` does.

    Args:
        simulator: The system.
        states: Positions, then velocities at the start, ``(N,)``.
        earlier: The same one step before, two steps before and so on.
    """
    names = [state.name for state in simulator.states]
    found = {}
    for column, sensor in enumerate(simulator.sensors):
        i = names.index(sensor.name) if sensor.name in names else None
        found[column] = tuple(
            torch.zeros_like(states[0]) if i is None else values[i] - states[i]
            for values in earlier
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
