"""Effects on commands and measurements of a whole batch, applied outside the engine.

In open loop, commands do not depend on the simulation, and the simulation does not depend on
measurements. Both kinds of effect are therefore computed outside the engine, for all simulations
at once in torch. Only force effects must be computed inside the engine.
"""

import copy
from collections.abc import Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.commands import command_records, commands_at
from npdr_ppl.engines.common.effect_chain import EffectChain, needed_histories
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.segment_start import recorded_start, true_start, with_past_commands
from npdr_ppl.language.effects import ActionEffect, SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

__all__ = ["Signals", "domain_by_segment", "needs_accelerations"]


def needs_accelerations(effect: SensorEffect) -> bool:
    """Returns whether an effect needs states at other times, i.e. the engine's accelerations."""
    return effect.needs_past or type(effect).lead is not SensorEffect.lead


def domain_by_segment(
    simulator: Simulator, parameters: Mapping[str, Tensor], inputs: Inputs
) -> tuple[dict[str, Tensor], torch.Size]:
    """Returns all parameters as they are in each segment, and their shape with the segments.

    Args:
        simulator: The simulator, whose parameter effects are applied.
        parameters: Parameters by name; missing ones are nominal.
        inputs: The segments, float64.
    """
    domain = simulator.complete(parameters, torch.float64, inputs.actions.device)
    batch_shape = torch.broadcast_shapes(
        inputs.batch_shape, *(value.shape for value in domain.values())
    )
    shape = torch.Size((*batch_shape, inputs.num_segments))
    middle = (inputs.start.to(torch.float64) + 0.5 * inputs.num_steps) * inputs.time_step
    by_segment = {name: value[..., None] for name, value in domain.items()}
    return simulator.changed(by_segment, middle), shape


class Signals:
    """Applies effects to commands for an engine and to sensor values from it.

    Args:
        simulator: Declares actions, sensors and effects.
        domain: All parameters, each broadcasting to ``shape``.
        inputs: The segments, float64.
        shape: The batch shape, followed by the number of segments. N is the product of all.

    Attributes:
        start_times: Seconds from the start of the rollout to each segment's start, ``(N,)``.
    """

    def __init__(
        self, simulator: Simulator, domain: Mapping[str, Tensor], inputs: Inputs, shape: torch.Size
    ) -> None:
        self._inputs = inputs
        self._recorded = recorded_start(simulator, inputs, shape)
        self.start_times = self._recorded.time

        def chain(
            kind: type[ActionEffect] | type[SensorEffect],
        ) -> tuple[_SignalChain, tuple[dict[str, Tensor], ...]]:
            part = copy.copy(simulator)
            part.effects = tuple(e for e in simulator.effects if isinstance(e, kind))
            effects = tuple(effect.own_parameters(domain) for effect in part.effects)
            histories = needed_histories(part.effects, effects, inputs.time_step)
            return _SignalChain(part, (), inputs.time_step, histories), flatten(effects, shape)

        # All commands are known before the engine runs, and measurements only afterwards.
        self._action_chain, self._action_parameters = chain(ActionEffect)
        self._sensor_chain, self._sensor_parameters = chain(SensorEffect)
        kept = self._action_chain.actions.num_kept_steps(inputs.past_actions.shape[-2])
        self._records = command_records(simulator, inputs, shape, torch.float64, kept)

    @property
    def has_action_effects(self) -> bool:
        """Whether actions for the engine may differ between simulations of the same segment."""
        return bool(self._action_chain.actions.effects)

    def initial_states(self) -> Tensor:
        """Returns the true state at each segment's start, ``(N, states)``.

        Offsets and scale errors of sensors are removed from the measurements.
        """
        tables = Tables(None, self._sensor_parameters)
        components = true_start(self._sensor_chain, tables, self._recorded, ()).states
        if not components:
            return torch.zeros(len(self.start_times), 0, dtype=torch.float64)
        return torch.stack(components, dim=-1)

    def actions(self) -> Tensor:
        """Returns the actions for the engine after all effects, ``(N, steps, actions)``."""
        if not self._records:
            shape = len(self.start_times), self._inputs.num_steps, 0
            return torch.zeros(shape, dtype=torch.float64)
        chain, tables = self._action_chain, Tables(None, self._action_parameters)
        past = chain.actions.num_past_steps(self._inputs.past_actions.shape[-2])
        settled = commands_at(self._records, -1 - past)
        state = chain.start((), (), tables, settled, (), self.start_times, num_past=past)
        state = with_past_commands(chain, state, tables, self._records, past)
        steps = []
        for step in range(self._inputs.num_steps):
            commands = list(commands_at(self._records, step))
            state, changed, _ = chain.actions.act_on_record(state, self._records, step, tables)
            for channel, action in changed.items():
                commands[channel] = action.expand_as(commands[channel])
            steps.append(torch.stack(commands, dim=-1))
        return torch.stack(steps, dim=-2)

    def readings(self, values: Tensor, initial_states: Tensor) -> Tensor:
        """Returns the measurements of true values after each step.

        Args:
            values: True values, ``(N, steps, sensors)``.
            initial_states: True states at the start, ``(N, states)``.
        """
        chain, effects = self._sensor_chain, self._sensor_parameters
        if not chain.sensors.effects:
            return values
        tables = Tables(self._true_at_start(values, initial_states), effects)
        state = chain.start((), (), tables, (), self._recorded.readings, self.start_times)
        steps = []
        for present in values.unbind(-2):
            state, read = chain.sensors.report(state, present.unbind(-1), tables)
            steps.append(torch.stack(read, dim=-1))
        return torch.stack(steps, dim=-2)

    def _true_at_start(self, values: Tensor, initial_states: Tensor) -> Components:
        """Returns each sensor's true value at the segments' start."""
        simulator = self._sensor_chain.simulator
        states = {s.name: initial_states[:, i] for i, s in enumerate(simulator.states)}
        # If a value is neither a state nor recorded, the value after the first step is used.
        return tuple(
            states.get(sensor.name, values[:, 0, place] if reading is None else reading)
            for place, (sensor, reading) in enumerate(
                zip(simulator.sensors, self._recorded.readings, strict=True)
            )
        )


class _SignalChain(EffectChain):
    """Effects between commands and the engine, or between the engine and measurements."""

    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true values at the start, which ``tables.constants`` contains."""
        return tables.constants

    def move(
        self, state: State, actions: Components, tables: Tables, moments: Moments = ()
    ) -> State:
        """Not used; the engine advances the state."""
        raise NotImplementedError
