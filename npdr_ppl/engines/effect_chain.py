"""Effects on their way through a step, whatever engine moves the state in between."""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from typing import Any, NamedTuple

from torch import Tensor

from npdr_ppl.engines.commands import RecentCommands
from npdr_ppl.engines.compilation import signature
from npdr_ppl.engines.integrators import Components
from npdr_ppl.language.effects import (
    ActionEffect,
    Commands,
    Effect,
    ForceEffect,
    SensorEffect,
)
from npdr_ppl.language.simulator import Simulator

__all__ = ["EffectChain", "State", "Tables", "needed_histories"]

# Histories come in multiples of this many steps, so that draws of a delay share a compiled kernel.
_HISTORY_GRAIN = 4


class State(NamedTuple):
    """What the next step needs; every tensor has the flat batch shape ``(N,)``.

    Attributes:
        positions: Generalised positions.
        velocities: Generalised velocities.
        force_memory: Own state of each force effect.
        action_memory: Own state of each action effect.
        past_commands: Past commands that each action effect may ask for, latest first.
        sensor_memory: Own state of each sensor effect for each of its channels.
    """

    positions: Components
    velocities: Components
    force_memory: tuple[Any, ...] = ()
    action_memory: tuple[Any, ...] = ()
    past_commands: tuple[Components, ...] = ()
    sensor_memory: tuple[tuple[Any, ...], ...] = ()


class Tables(NamedTuple):
    """What stays constant during a simulation.

    Attributes:
        constants: The model author's constants.
        effects: Parameters of each effect by short name, in the order of attachment.
    """

    constants: Any
    effects: tuple[dict[str, Tensor], ...]


class EffectChain(ABC):
    """Passes commands and readings through the effects attached to a simulator.

    What moves the state is an engine's own matter.

    Args:
        simulator: The system and its effects.
        joints: Names of the force ports, in the order of the coordinates that they act on.
        time_step: Seconds per step.
        histories: Past commands that each action effect may ask for; see
            :func:`needed_histories`.

    Attributes:
        force_effects: Place in ``Tables.effects``, effect and joint of each force effect.
        action_effects: Place, effect and action channel of each action effect.
        sensor_effects: Place, effect and sensor channels of each sensor effect.
    """

    def __init__(
        self,
        simulator: Simulator,
        joints: tuple[str, ...],
        time_step: float,
        histories: tuple[int, ...],
    ) -> None:
        self.simulator = simulator
        self.time_step = time_step
        self.histories = histories
        actions = [channel.name for channel in simulator.actions]
        sensors = [channel.name for channel in simulator.sensors]
        self.force_effects: list[tuple[int, ForceEffect, int]] = []
        self.action_effects: list[tuple[int, ActionEffect, int]] = []
        self.sensor_effects: list[tuple[int, SensorEffect, tuple[int, ...]]] = []
        for place, effect in enumerate(simulator.effects):
            if isinstance(effect, ForceEffect):
                self.force_effects.append((place, effect, joints.index(effect.port)))
            elif isinstance(effect, ActionEffect):
                self.action_effects.append((place, effect, actions.index(effect.port)))
            elif isinstance(effect, SensorEffect):
                channels = simulator.port(effect.port).channels
                columns = tuple(sensors.index(name) for name in channels)
                self.sensor_effects.append((place, effect, columns))

    @property
    def signature(self) -> Hashable:
        """Equal for chains that compile to the same code."""
        return signature(self.simulator), self.time_step, self.histories

    @property
    def num_positions(self) -> int:
        """How many of the simulator's states are positions; the others are velocities."""
        return len(self.simulator.states) // 2

    @abstractmethod
    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true value of every sensor channel, ``(N,)`` each."""

    @abstractmethod
    def move(self, state: State, actions: Components, tables: Tables) -> State:
        """Advances the dynamics by one time step under constant actions."""

    def at_joints(
        self, positions: Components, velocities: Components
    ) -> tuple[Components, Components]:
        """Returns position and velocity at each force port; by default all coordinates."""
        return positions, velocities

    def start(
        self,
        positions: Components,
        velocities: Components,
        tables: Tables,
        commands: Components,
        readings: tuple[Tensor | None, ...],
    ) -> State:
        """Returns the state at the start of an episode or segment.

        Args:
            positions: Positions, ``(N,)`` each.
            velocities: Velocities, ``(N,)`` each.
            tables: Constants of the simulation.
            commands: What each action channel saw for long before the start, ``(N,)`` each.
            readings: What each sensor reported at the start, ``(N,)`` each; ``None`` for the
                true value.
        """
        # Only what some effect asks for is computed: short simulations start often.
        true: Components = ()
        reported: Components = ()
        if self.sensor_effects:
            true = self.true_readings(positions, velocities, tables)
            reported = tuple(
                value if read is None else read for value, read in zip(true, readings, strict=True)
            )
        joint_positions, joint_velocities = positions, velocities
        if self.force_effects:
            joint_positions, joint_velocities = self.at_joints(positions, velocities)
        return State(
            positions,
            velocities,
            tuple(
                effect.initial_memory(joint_positions[joint], joint_velocities[joint])
                for _, effect, joint in self.force_effects
            ),
            tuple(
                effect.initial_memory(commands[channel])
                for _, effect, channel in self.action_effects
            ),
            tuple(
                (commands[channel],) * length
                for (_, _, channel), length in zip(
                    self.action_effects, self.histories, strict=True
                )
            ),
            tuple(
                tuple(effect.initial_memory(true[c], reported[c]) for c in columns)
                for _, effect, columns in self.sensor_effects
            ),
        )

    def act(
        self,
        state: State,
        commands: Components,
        tables: Tables,
        records: tuple[Commands, ...] | None = None,
    ) -> tuple[State, Components]:
        """Passes the commands of one step through the action effects.

        Args:
            state: State at the step's start.
            commands: One per action channel, within the channel's limits already: a limit sits
                where the command enters the device, and recordings hold limited commands.
            tables: Constants of the simulation.
            records: Where the whole past of each channel is on record, a view of it.

        Returns:
            The state with the action effects' memory advanced, and what reaches the dynamics.
        """
        if not self.action_effects:
            return state, commands
        present = list(commands)
        memory, past = list(state.action_memory), list(state.past_commands)
        is_raw = [True] * len(present)
        for k, (place, effect, channel) in enumerate(self.action_effects):
            # The first effect of a chain can look into the record; later ones see what those
            # before them made of it, and keep a history of that.
            command = present[channel]
            if records is not None and is_raw[channel]:
                seen = records[channel]
            else:
                seen = RecentCommands(command, past[k])
            present[channel], memory[k] = effect.act(
                seen, tables.effects[place], memory[k], self.time_step
            )
            if self.histories[k]:
                past[k] = (command, *past[k][:-1])
            is_raw[channel] = False
        changed = state._replace(action_memory=tuple(memory), past_commands=tuple(past))
        return changed, tuple(present)

    def read(self, state: State, tables: Tables) -> tuple[State, Components]:
        """Returns the state with the sensor effects' memory advanced, and the readings."""
        true = self.true_readings(state.positions, state.velocities, tables)
        return self.report(state, true, tables)

    def report(self, state: State, true: Components, tables: Tables) -> tuple[State, Components]:
        """Passes the true values of one step through the sensor effects; see :meth:`read`."""
        if not self.sensor_effects:
            return state, true
        readings, memories = list(true), []
        for (place, effect, columns), memory in zip(
            self.sensor_effects, state.sensor_memory, strict=True
        ):
            changed = list(memory)
            for m, column in enumerate(columns):
                readings[column], changed[m] = effect.read(
                    readings[column], tables.effects[place], memory[m], self.time_step
                )
            memories.append(tuple(changed))
        return state._replace(sensor_memory=tuple(memories)), tuple(readings)

    def applied_force(self, joint: int, state: State, tables: Tables) -> Tensor | None:
        """Returns the smooth force of all effects at one joint; ``None`` where there is none."""
        total: Tensor | None = None
        for k, (place, effect, where) in enumerate(self.force_effects):
            if where == joint:
                force = effect.force(
                    state.positions[joint],
                    state.velocities[joint],
                    tables.effects[place],
                    state.force_memory[k],
                )
                if force is not None:
                    total = force if total is None else total + force
        return total

    def dry_friction_bounds(self, state: State, tables: Tables) -> tuple[Tensor | None, ...]:
        """Returns the summed bounds of dry friction per joint."""
        bounds: list[Tensor | None] = [None] * len(state.positions)
        for k, (place, effect, joint) in enumerate(self.force_effects):
            bound = effect.dry_friction(
                state.positions[joint],
                state.velocities[joint],
                tables.effects[place],
                state.force_memory[k],
            )
            if bound is not None:
                present = bounds[joint]
                bounds[joint] = bound if present is None else present + bound
        return tuple(bounds)

    def next_force_memory(self, state: State, tables: Tables, step: float) -> tuple[Any, ...]:
        """Returns the force effects' own state a step of some seconds later."""
        return tuple(
            effect.next_memory(
                state.positions[joint],
                state.velocities[joint],
                tables.effects[place],
                state.force_memory[k],
                step,
            )
            for k, (place, effect, joint) in enumerate(self.force_effects)
        )


def needed_histories(
    effects: tuple[Effect, ...], parameters: tuple[Mapping[str, Tensor], ...], time_step: float
) -> tuple[int, ...]:
    """Returns how many past commands each action effect may ask for, rounded up.

    Args:
        effects: The effects attached to a simulator.
        parameters: Parameters of each by short name.
        time_step: Seconds per step.
    """
    needed = [
        effect.history(values, time_step)
        for effect, values in zip(effects, parameters, strict=True)
        if isinstance(effect, ActionEffect)
    ]
    return tuple(-(-number // _HISTORY_GRAIN) * _HISTORY_GRAIN for number in needed)
