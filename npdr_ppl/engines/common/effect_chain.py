"""Applies effects before, during and after a step, for every engine."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npdr_ppl.engines.common.commands import RecentCommands
from npdr_ppl.engines.common.compilation import signature
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.measurement_times import earlier_changes
from npdr_ppl.engines.common.past_motion import PastMotion
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import (
    ActionEffect,
    Commands,
    Effect,
    ForceEffect,
    SensorEffect,
    Uneven,
)
from npdr_ppl.language.simulator import Simulator

__all__ = ["EffectChain", "Moments", "State", "Tables", "needed_histories"]

# Steps of past commands from which the memory of action effects at a segment's start is computed,
# if no effect asks for more: longer than the delays of working control loops.
_PAST_STEPS = 64

# Lengths of histories are rounded up to multiples of this number of steps, so that different draws
# of a delay share a compiled kernel.
_HISTORY_GRAIN = 4


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
        servo_memory: Own state of each effect inside a servo.
    """

    positions: Components
    velocities: Components
    force_memory: tuple[Any, ...] = ()
    action_memory: tuple[Any, ...] = ()
    past_commands: tuple[Components, ...] = ()
    sensor_memory: tuple[tuple[Any, ...], ...] = ()
    servo_memory: tuple[Tensor | None, ...] = ()


class Tables(NamedTuple):
    """Data that stay constant during a simulation.

    Attributes:
        constants: The model author's constants.
        effects: Parameters of each effect by short name, in the order of attachment.
    """

    constants: Any
    effects: tuple[dict[str, Tensor], ...]


class EffectChain(ABC):
    """Passes commands and measurements through the effects attached to a simulator.

    Subclasses advance the state with their engine.

    Args:
        simulator: The system and its effects.
        joints: Names of the force ports, in the order of the coordinates that they act on.
        time_step: Seconds per step.
        histories: Number of past commands that each action effect may need at each of its
            channels, then of past values that each sensor effect may need; see
            :func:`needed_histories`.

    Attributes:
        force_effects: Index in ``Tables.effects``, effect and joint of each force effect.
        action_effects: Index, effect and action channel of each action effect at each of its
            channels.
        sensor_effects: Index, effect and sensor channels of each sensor effect.
        needs_joints: Whether a force effect needs a :class:`Joint` before every step.
    """

    def __init__(
        self,
        simulator: Simulator,
        joints: tuple[str, ...],
        time_step: float,
        histories: tuple[int, ...],
    ) -> None:
        self.simulator = simulator
        self.joints = joints
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
                for name in effect.channels:
                    self.action_effects.append((place, effect, actions.index(name)))
            elif isinstance(effect, SensorEffect):
                port = simulator.port(effect.port)
                channels = sensors if port.kind == "clock" else port.channels
                columns = tuple(sensors.index(name) for name in channels)
                self.sensor_effects.append((place, effect, columns))
        self.needs_joints = any(effect.needs_joint for _, effect, _ in self.force_effects)

    @property
    def position_channels(self) -> tuple[str | None, ...]:
        """Name of the state that is each joint's position, ``None`` if it is no state."""
        return tuple(state.name for state in self.simulator.states)

    @property
    def channels_with_past(self) -> tuple[str | None, ...]:
        """The same; ``None`` also where no force effect needs the motion before a segment."""
        joints = {joint for _, effect, joint in self.force_effects if effect.needs_past}
        names = self.position_channels if joints else ()
        return tuple(name if joint in joints else None for joint, name in enumerate(names))

    @property
    def force_step(self) -> float:
        """Seconds between two evaluations of the force effects."""
        return self.time_step

    def num_past_steps(self, recorded: int) -> int:
        """Returns from how many steps of past commands a segment's start is computed.

        Args:
            recorded: Number of past steps that are included in the inputs.
        """
        if not self.action_effects:
            return 0
        steps = [0.0] * len(self.simulator.actions)
        for (_, effect, channel), history in zip(
            self.action_effects, self.histories, strict=False
        ):
            steps[channel] += effect.memory_time / self.time_step + history
        return min(recorded, max(_PAST_STEPS, math.ceil(min(max(steps), recorded))))

    def num_kept_steps(self, recorded: int) -> int:
        """Returns how many of the recorded past steps an effect may look at."""
        return min(recorded, max(_PAST_STEPS, self.num_past_steps(recorded)))

    @property
    def signature(self) -> Hashable:
        """Equal for chains that compile to the same code."""
        return signature(self.simulator), self.time_step, self.histories

    @property
    def num_positions(self) -> int:
        """Number of the simulator's states that are positions; the others are velocities."""
        return len(self.simulator.states) // 2

    @abstractmethod
    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true value of every sensor channel, ``(N,)`` each."""

    def accelerations(
        self, positions: Components, velocities: Components, actions: Components, tables: Tables
    ) -> Components:
        """Returns the rate of each velocity among the states, without any effect.

        Args:
            positions: Positions among the states, ``(N,)`` each.
            velocities: Velocities among the states, ``(N,)`` each.
            actions: Actions after all effects, ``(N,)`` each.
            tables: Constants of the simulation.

        Raises:
            NotImplementedError: The chain has no access to the engine's accelerations; effects
                that need them cannot be attached.
        """
        raise NotImplementedError

    @abstractmethod
    def move(
        self, state: State, actions: Components, tables: Tables, moments: Moments = ()
    ) -> State:
        """Advances the dynamics by one time step.

        Args:
            state: State at the step's start.
            actions: Mean of each action over the step, ``(N,)`` each.
            tables: Constants of the simulation.
            moments: First moment of each action about the step's middle; empty if all are
                constant. An engine that holds actions during a step ignores them.
        """

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
        time: Tensor,
        *,
        commands_before: Callable[[int], Components] | None = None,
        num_past: int = 0,
        past_motion: PastMotion | None = None,
    ) -> State:
        """Returns the state at the start of an episode or segment.

        Args:
            positions: Positions, ``(N,)`` each.
            velocities: Velocities, ``(N,)`` each.
            tables: Constants of the simulation.
            commands: Constant command of each action channel before the start, or, with
                ``num_past``, before these past steps, ``(N,)`` each.
            readings: Measurement of each sensor at the start, ``(N,)`` each; ``None`` for the
                true value.
            time: Seconds since the rollout began, ``(N,)``.
            commands_before: Returns the command of each action channel at a step before 0;
                ``None`` for ``commands``.
            num_past: Steps before the start through which the caller will advance the action
                effects.
            past_motion: Motion of the joints before the start; ``None`` if it is unknown.
        """
        step, split = self.time_step, len(self.action_effects)
        moved = past_motion or PastMotion()
        earlier = time - num_past * step
        joint_positions, joint_velocities = positions, velocities
        if self.force_effects:
            joint_positions, joint_velocities = self.at_joints(positions, velocities)
        return State(
            positions,
            velocities,
            tuple(
                effect.initial_memory(
                    joint_positions[joint],
                    joint_velocities[joint],
                    moved.put_into(Start(time, self.force_step, tables.effects[place]), joint),
                )
                for place, effect, joint in self.force_effects
            ),
            tuple(
                effect.initial_memory(
                    commands[channel], Start(earlier, step, tables.effects[place], length)
                )
                for (place, effect, channel), length in zip(
                    self.action_effects, self.histories[:split], strict=True
                )
            ),
            tuple(
                (commands[channel],) * length
                for (_, _, channel), length in zip(
                    self.action_effects, self.histories[:split], strict=True
                )
            ),
            self._sensor_memory(
                positions,
                velocities,
                tables,
                commands_before or (lambda _: commands),
                readings,
                time,
            ),
        )

    def _sensor_memory(
        self,
        positions: Components,
        velocities: Components,
        tables: Tables,
        commands_before: Callable[[int], Components],
        readings: tuple[Tensor | None, ...],
        time: Tensor,
    ) -> tuple[tuple[Any, ...], ...]:
        """Returns the sensor effects' own state at the start; see :meth:`start`."""
        # Only values that an effect needs are computed, because short simulations start often.
        if not self.sensor_effects:
            return ()
        true = self.true_readings(positions, velocities, tables)
        lengths = self.histories[len(self.action_effects) :]
        num_before = max(
            length if effect.needs_past else 0
            for (_, effect, _), length in zip(self.sensor_effects, lengths, strict=True)
        )
        changes: dict[int, tuple[Tensor, ...]] = {}
        if num_before:

            def accelerations(states: Components, step: int) -> Components:
                split = self.num_positions
                commands = commands_before(step)
                return self.accelerations(states[:split], states[split:], commands, tables)

            states = (*positions, *velocities)
            changes = earlier_changes(
                self.simulator, states, accelerations, self.time_step, num_before
            )
        simulator = self.simulator
        states = zip(simulator.states, simulator.is_rate, strict=True)
        of_rates = {state.name for state, is_rate in states if is_rate}
        is_rate = [sensor.name in of_rates for sensor in simulator.sensors]

        def start(place: int, length: int, column: int) -> Start:
            own, known = tables.effects[place], changes.get(column, ())[:length]
            return Start(time, self.time_step, own, length, known, is_rate[column])

        return tuple(
            tuple(
                effect.initial_memory(
                    true[c],
                    true[c] if (reported := readings[c]) is None else reported,
                    start(place, length, c),
                )
                for c in columns
            )
            for (place, effect, columns), length in zip(self.sensor_effects, lengths, strict=True)
        )

    def advance(
        self,
        state: State,
        commands: Components,
        tables: Tables,
        records: tuple[Commands, ...] | None = None,
    ) -> State:
        """Advances the state by one time step under commands; see :meth:`act`."""
        state, actions, moments = self.act(state, commands, tables, records)
        return self.move(state, actions, tables, moments)

    def by_substep(
        self, actions: Components, moments: Moments, substeps: int
    ) -> tuple[list[Components], Moments]:
        """Divides actions that change within a step among its substeps.

        An action is replaced by a straight line with the same mean and moment over the step.

        Args:
            actions: Mean of each action, see :meth:`move`.
            moments: Their moments.
            substeps: Number of substeps.

        Returns:
            The mean of each action in each substep, and its moment within a substep.
        """
        own = tuple(None if m is None else m / substeps**3 for m in moments)
        if all(moment is None for moment in own):
            return [actions] * substeps, own
        rise = 12.0 * (substeps / self.time_step) ** 2
        means = [
            tuple(
                a if m is None else torch.add(a, m, alpha=rise * (k - 0.5 * (substeps - 1)))
                for a, m in zip(actions, own, strict=True)
            )
            for k in range(substeps)
        ]
        return means, own

    def act(
        self,
        state: State,
        commands: Components,
        tables: Tables,
        records: tuple[Commands, ...] | None = None,
    ) -> tuple[State, Components, Moments]:
        """Passes the commands of one step through the action effects.

        Args:
            state: State at the step's start.
            commands: One per action channel, already within the channel's limits: a device limits
                commands at its input, and recordings contain limited commands.
            tables: Constants of the simulation.
            records: Views of the recorded commands of each channel, if the whole past is recorded.

        Returns:
            The state with the action effects' memory advanced, the actions after all effects, and
            their moments; see :meth:`move`.
        """
        if not self.action_effects:
            return state, commands, ()
        present = list(commands)
        moments: list[Tensor | None] = [None] * len(commands)
        memory, past = list(state.action_memory), list(state.past_commands)
        is_raw = [True] * len(present)
        for k, (place, effect, channel) in enumerate(self.action_effects):
            # The first effect of a chain can use the record. Later effects receive the output of
            # the effect before them and keep a history of it.
            command = present[channel]
            if records is not None and is_raw[channel]:
                seen = records[channel]
            else:
                seen = RecentCommands(command, past[k])
            reached, memory[k] = effect.act(seen, tables.effects[place], memory[k], self.time_step)
            if isinstance(reached, Uneven):
                reached, moment = reached
                _add(moments, channel, moment)
            present[channel] = reached
            if self.histories[k]:
                past[k] = (command, *past[k][:-1])
            is_raw[channel] = False
        changed = state._replace(action_memory=tuple(memory), past_commands=tuple(past))
        return changed, tuple(present), tuple(moments)

    def read(self, state: State, tables: Tables) -> tuple[State, Components]:
        """Returns the state with the sensor effects' memory advanced, and the measurements."""
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

    def applied_forces(
        self,
        positions: Components,
        velocities: Components,
        state: State,
        tables: Tables,
        *,
        before_step: bool = False,
    ) -> tuple[Tensor | None, ...]:
        """Returns the sum of smooth effect forces at each joint; ``None`` if there is no force.

        Args:
            positions: Position of each joint, ``(N,)`` each.
            velocities: Their rates.
            state: State with the effects' memory.
            tables: Constants of the simulation.
            before_step: Whether to leave out effects that still need their :class:`Joint`.
        """
        forces: list[Tensor | None] = [None] * len(positions)
        for k, (place, effect, joint) in enumerate(self.force_effects):
            if before_step and effect.needs_joint:
                continue
            force = effect.force(
                positions[joint], velocities[joint], tables.effects[place], state.force_memory[k]
            )
            _add(forces, joint, force)
        return tuple(forces)

    def force_moments(self, state: State, tables: Tables) -> tuple[Tensor | None, ...]:
        """Returns the moments of the forces within the present step, per joint."""
        moments: list[Tensor | None] = [None] * len(state.positions)
        for k, (place, effect, joint) in enumerate(self.force_effects):
            if effect.needs_joint:
                moment = effect.moment(tables.effects[place], state.force_memory[k])
                _add(moments, joint, moment)
        return tuple(moments)

    def begin_step(self, state: State, joints: Sequence[Joint | None], tables: Tables) -> State:
        """Passes the joints to the force effects that need them.

        Args:
            state: State at the step's start.
            joints: Each joint; ``None`` if no effect needs it.
            tables: Constants of the simulation.
        """
        memory = list(state.force_memory)
        for k, (place, effect, joint) in enumerate(self.force_effects):
            seen = joints[joint]
            if effect.needs_joint and seen is not None:
                others = zip(self.joints, joints, strict=True)
                seen = seen._replace(
                    others={
                        name: (other.position, other.velocity)
                        for place_of_other, (name, other) in enumerate(others)
                        if other is not None and place_of_other != joint
                    }
                )
                memory[k] = effect.begin_step(
                    seen, tables.effects[place], memory[k], self.force_step
                )
        return state._replace(force_memory=tuple(memory))

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
            _add(bounds, joint, bound)
        return tuple(bounds)

    def next_force_memory(self, state: State, tables: Tables) -> tuple[Any, ...]:
        """Returns the force effects' own state at their next evaluation."""
        return tuple(
            effect.next_memory(
                state.positions[joint],
                state.velocities[joint],
                tables.effects[place],
                state.force_memory[k],
                self.force_step,
            )
            for k, (place, effect, joint) in enumerate(self.force_effects)
        )


def needed_histories(
    effects: tuple[Effect, ...], parameters: tuple[Mapping[str, Tensor], ...], time_step: float
) -> tuple[int, ...]:
    """Returns how many past steps action effects, then sensor effects, need, rounded up.

    An action effect at several channels has a number for each.

    Args:
        effects: The effects attached to a simulator.
        parameters: Parameters of each by short name.
        time_step: Seconds per step.
    """
    needed = [
        effect.history(values, time_step)
        for kind in (ActionEffect, SensorEffect)
        for effect, values in zip(effects, parameters, strict=True)
        if isinstance(effect, kind)
        for _ in (effect.channels if kind is ActionEffect else (effect.port,))
    ]
    return tuple(-(-number // _HISTORY_GRAIN) * _HISTORY_GRAIN for number in needed)


def _add(totals: list[Tensor | None], place: int, part: Tensor | None) -> None:
    """Adds to a total; ``None`` counts as zero and needs no operation."""
    total = totals[place]
    if part is not None:
        totals[place] = part if total is None else total + part
