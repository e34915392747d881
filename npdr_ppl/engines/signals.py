"""Effects on commands and readings of a whole batch, for engines that see neither.

In open loop commands do not depend on what the simulation does, and it does not depend on what
sensors make of it. So both kinds of effect stay outside of the engine, where torch treats all
simulations at once; only forces have to go in.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from npdr_ppl.engines.commands import CommandRecord, RecordedCommands
from npdr_ppl.engines.integrators import Components
from npdr_ppl.engines.stepping import State, Stepper, Tables, flatten
from npdr_ppl.language.effects import ActionEffect, SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

if TYPE_CHECKING:
    from npdr_ppl.engines.ode import ODESimulator

__all__ = ["Signals"]


class Signals:
    """The way of commands to an engine, and of its readings back.

    Args:
        simulator: Declares actions, sensors and effects.
        domain: All parameters, each broadcasting to ``shape``.
        inputs: The segments, float64.
        shape: The batch shape and the segments, of numel N.
    """

    def __init__(
        self, simulator: Simulator, domain: Mapping[str, Tensor], inputs: Inputs, shape: torch.Size
    ) -> None:
        self._simulator = simulator
        self._inputs = inputs
        self._shape = shape
        chosen = tuple(e for e in simulator.effects if isinstance(e, ActionEffect | SensorEffect))
        # The stepper asks a simulator for these things only where no joint is concerned.
        ends = cast("ODESimulator", _Ends(simulator, chosen))
        effects = tuple(effect.own_parameters(domain) for effect in chosen)
        histories = Stepper.needed_histories(ends, effects, inputs.time_step)
        self._stepper = Stepper(ends, inputs.time_step, histories)
        self._effects = flatten(effects, shape)
        columns = {name: i for i, name in enumerate(inputs.action_names)}
        self._records = tuple(
            CommandRecord(inputs, columns[a.name], shape, (a.lower, a.upper), torch.float64)
            for a in simulator.actions
        )

    @property
    def has_action_effects(self) -> bool:
        """Whether what reaches the engine differs between simulations of the same segment."""
        return bool(self._stepper.action_effects)

    def initial_states(self) -> Tensor:
        """Returns the true state at each segment's start, ``(N, states)``.

        An offset or a wrong scale of a sensor is taken out of what was read there.
        """
        simulator = self._simulator
        components = {
            state.name: value.expand(self._shape).reshape(-1)
            for state, value in zip(
                simulator.states, simulator.initial_states(self._inputs), strict=True
            )
        }
        for place, effect, columns in self._stepper.sensor_effects:
            for name in (simulator.sensors[column].name for column in columns):
                if name in components:
                    components[name] = effect.initial_value(components[name], self._effects[place])
        if not components:
            return torch.zeros(self._shape.numel(), 0, dtype=torch.float64)
        return torch.stack(list(components.values()), dim=-1)

    def actions(self) -> Tensor:
        """Returns what reaches the engine, ``(N, steps, actions)``."""
        empty = Tables(None, self._effects)
        past = self._inputs.past_actions.shape[-2]
        settled = tuple(record.at(-1 - past) for record in self._records)
        state = State(
            (),
            (),
            action_memory=tuple(
                effect.initial_memory(settled[channel])
                for _, effect, channel in self._stepper.action_effects
            ),
            past_commands=tuple(
                (settled[channel],) * length
                for (_, _, channel), length in zip(
                    self._stepper.action_effects, self._stepper.histories, strict=True
                )
            ),
        )
        steps = []
        for step in range(-past, self._inputs.num_steps):
            commands = tuple(record.at(step) for record in self._records)
            views = tuple(
                RecordedCommands(command, r.table, r.rows, r.first + step, r.stride)
                for command, r in zip(commands, self._records, strict=True)
            )
            state, reached = self._stepper.act(state, commands, empty, views)
            if step >= 0:
                steps.append(torch.stack([x.expand_as(commands[0]) for x in reached], dim=-1))
        return torch.stack(steps, dim=-2)

    def readings(self, values: Tensor, initial_states: Tensor) -> Tensor:
        """Returns what the sensors make of true values after each step.

        Args:
            values: True values, ``(N, steps, sensors)``.
            initial_states: True states at the start, ``(N, states)``.
        """
        if not self._stepper.sensor_effects:
            return values
        true, reported = self._at_start(values, initial_states)
        state = State(
            (),
            (),
            sensor_memory=tuple(
                tuple(effect.initial_memory(true[c], reported[c]) for c in columns)
                for _, effect, columns in self._stepper.sensor_effects
            ),
        )
        steps = []
        for present in values.unbind(-2):
            tables = Tables(present.unbind(-1), self._effects)
            state, read = self._stepper.read(state, tables)
            steps.append(torch.stack(read, dim=-1))
        return torch.stack(steps, dim=-2)

    def _at_start(
        self, values: Tensor, initial_states: Tensor
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Returns each sensor's true value and its reading at the segments' start."""
        inputs = self._inputs
        states = {s.name: initial_states[:, i] for i, s in enumerate(self._simulator.states)}
        columns = {name: i for i, name in enumerate(inputs.channel_names)}
        true, reported = [], []
        for place, sensor in enumerate(self._simulator.sensors):
            reading = None
            if sensor.name in columns:
                recorded = inputs.initial_readings[..., columns[sensor.name]]
                reading = recorded.expand(self._shape).reshape(-1)
            # A value that is neither a state nor recorded is that after the first step.
            value = states.get(sensor.name, values[:, 0, place] if reading is None else reading)
            true.append(value)
            reported.append(value if reading is None else reading)
        return true, reported


class _Ends:
    """What a stepper needs of a simulator for commands and readings; it has no joints."""

    joints = ()
    substeps = 1

    def __init__(self, simulator: Simulator, effects: tuple) -> None:
        self.actions = simulator.actions
        self.sensors = simulator.sensors
        self.effects = effects
        self.port = simulator.port

    def readings(
        self, positions: Components, velocities: Components, constants: Components
    ) -> Components:
        """Returns the true values, which are the step's constants here."""
        return constants
