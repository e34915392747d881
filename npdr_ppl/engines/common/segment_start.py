"""True initial states of segments: recorded values with the sensor effects removed."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from npdr_ppl.engines.common.action_effects import ActionEffects
from npdr_ppl.engines.common.alike import alike
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.commands import CommandRecord, commands_at
from npdr_ppl.engines.common.effect_chain import EffectChain
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.measurement_times import catch_up, sensor_leads
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

__all__ = [
    "RecordedStart",
    "TrueStart",
    "after_past_commands",
    "recorded_start",
    "true_start",
    "with_past_commands",
]


class RecordedStart(NamedTuple):
    """Data at the start of the segments; tensors of the flat batch shape ``(N,)``.

    Attributes:
        states: Each state component as recorded or estimated from records.
        readings: Measurement of each sensor; ``None`` if it was not recorded.
        time: Seconds since the rollout began.
        is_derived: Whether each state component is the rate of a recorded position.
        is_recorded: Whether each state component was recorded itself.
        is_held: Whether the robot was held in its first pose until its rollout began.
    """

    states: Components
    readings: tuple[Tensor | None, ...]
    time: Tensor
    is_derived: tuple[bool, ...]
    is_recorded: tuple[bool, ...]
    is_held: Tensor

    def part(self, first: int, last: int) -> "RecordedStart":
        """Returns the data of some of the N simulations."""
        return RecordedStart(
            tuple(value[first:last] for value in self.states),
            tuple(None if value is None else value[first:last] for value in self.readings),
            self.time[first:last],
            self.is_derived,
            self.is_recorded,
            self.is_held[first:last],
        )


class TrueStart(NamedTuple):
    """The true state at the start of the segments; components of the flat batch shape ``(N,)``.

    Attributes:
        states: The state.
        earlier: The state one step before, two steps before and so on, as far as effects on
            sensors need them. Empty where they are to be computed backwards from the start; see
            :mod:`~npdr_ppl.engines.common.measurement_times`.
    """

    states: Components
    earlier: tuple[Components, ...]


def recorded_start(simulator: Simulator, inputs: Inputs, shape: torch.Size) -> RecordedStart:
    """Returns the recorded data at the start of the segments.

    Args:
        simulator: The simulator.
        inputs: The segments.
        shape: Shape of the batch and the segments, of numel N.
    """

    def spread(value: Tensor) -> Tensor:
        return value.expand(shape).reshape(-1)

    columns = {name: i for i, name in enumerate(inputs.channel_names)}
    has_rates, states = inputs.initial_rates is not None, simulator.initial_states(inputs)
    return RecordedStart(
        tuple(spread(value) for value in states),
        tuple(
            spread(inputs.initial_readings[..., columns[s.name]]) if s.name in columns else None
            for s in simulator.sensors
        ),
        spread(inputs.start.to(inputs.initial_values) * inputs.time_step),
        tuple(has_rates and state.rate_of in columns for state in simulator.states),
        tuple(state.name in columns for state in simulator.states),
        spread(_is_held(simulator, inputs, states)),
    )


def _is_held(simulator: Simulator, inputs: Inputs, states: Sequence[Tensor]) -> Tensor:
    """Returns which segments begin a rollout at rest, a mask that broadcasts to ``(…, S)``.

    If nothing moves at the first sample, something held the robot until then, or it was in
    equilibrium, where both are the same. Otherwise it moved before, under the same laws. A
    recording that begins where a motion turns back is taken for the first.

    Args:
        simulator: The simulator.
        inputs: The segments.
        states: Its state at their start.
    """
    columns = {name: i for i, name in enumerate(inputs.channel_names)}
    held = (inputs.start == 0).to(inputs.initial_values.device)
    for state, is_rate, speed in zip(simulator.states, simulator.is_rate, states, strict=True):
        if not is_rate:
            continue
        # A measured velocity is more accurate than one from later positions.
        if inputs.is_zero is None:
            held = held & (speed == 0.0)
        elif state.name in columns:
            held = held & inputs.is_zero[..., 0, columns[state.name]]
        elif state.rate_of in columns:
            held = held & inputs.is_zero[..., 1, columns[state.rate_of]]
        else:
            held = torch.zeros_like(held)
    return held


def true_start(
    chain: EffectChain,
    tables: Tables,
    recorded: RecordedStart,
    records: Sequence[CommandRecord],
) -> TrueStart:
    """Returns the true state, computed from recorded values by removing the sensor effects.

    A velocity that was derived from position measurements has the scale and timing of the position
    sensor. It does not have the offset or scale of the velocity sensor. Where the robot was held
    until its rollout began, late measurements show the same pose.

    Args:
        chain: The effects.
        tables: The effects' parameters.
        recorded: The recorded data at the start.
        records: Commands of each action channel.
    """
    if not chain.sensors.effects:
        return TrueStart(recorded.states, ())
    states = chain.simulator.states
    places = {state.name: i for i, state in enumerate(states)}
    sensors = {sensor.name: i for i, sensor in enumerate(chain.simulator.sensors)}
    true = list(recorded.states)
    # The last effect changed the measurement last, so it is removed first.
    for place, effect, columns in reversed(chain.sensors.effects):
        for i, state in enumerate(states):
            value = true[i]
            if sensors.get(state.name) in columns:
                value = effect.initial_value(value, tables.effects[place])
            if recorded.is_derived[i]:
                rate, position = true[i], state.rate_of or ""
                if sensors.get(position) in columns and position in places:
                    here = true[places[position]]
                    rate = effect.initial_rate(rate, here, tables.effects[place])
                # At the first sample of a rollout, measured velocities are used; see
                # Simulator.initial_states.
                is_measured = (recorded.time == 0.0) & recorded.is_recorded[i]
                value = torch.where(is_measured, value, rate)
            true[i] = value
    leads = sensor_leads(chain.sensors.effects, tables.effects, recorded.time)
    leads = {column: lead.where(~recorded.is_held, 0.0) for column, lead in leads.items()}
    if not leads:
        return TrueStart(tuple(true), ())
    sources = (
        sensors.get((state.rate_of or "") if is_derived else state.name)
        for state, is_derived in zip(states, recorded.is_derived, strict=True)
    )
    late = tuple(None if source is None else leads.get(source) for source in sources)
    split = chain.num_positions

    def accelerations(states: Components, step: int) -> Components:
        commands = commands_at(records, step)
        return chain.accelerations(states[:split], states[split:], commands, tables)

    return TrueStart(
        *catch_up(
            chain.simulator,
            tuple(true),
            accelerations,
            late,
            chain.time_step,
            num_parts=chain.num_parts,
            num_before=chain.sensors.num_before,
        )
    )


def with_past_commands(
    chain: EffectChain,
    state: State,
    tables: Tables,
    records: tuple[CommandRecord, ...],
    num_steps: int,
) -> State:
    """Returns the state after the recorded past commands have updated the action effects' memory.

    Args:
        chain: The effects.
        state: State at the start of the segments, as if the oldest command had been constant.
        tables: The effects' parameters.
        records: Commands of each action channel.
        num_steps: Number of past steps that were recorded.
    """
    if not chain.actions.effects or not num_steps:
        return state
    few = alike(chain.actions, state, tables, records)
    changed = after_past_commands(chain.actions, few.state, few.tables, few.records, num_steps)
    return few.spread(state, changed)


def after_past_commands(
    actions: ActionEffects,
    state: State,
    tables: Tables,
    records: tuple[CommandRecord, ...],
    num_steps: int,
    *,
    until: int = 0,
) -> State:
    """Does the same as :func:`with_past_commands`, from each simulation's own commands.

    It stops before the step ``until``; the segment's first step is 0.
    """
    for step in range(-num_steps, until):
        state, _, _ = actions.act_on_record(state, records, step, tables)
    return state
