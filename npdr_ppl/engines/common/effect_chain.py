"""Applies effects before, during and after a step, for every engine."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

from torch import Tensor

from npdr_ppl.engines.common.action_effects import ActionEffects
from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.compilation import signature
from npdr_ppl.engines.common.force_effects import ForceEffects
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.measurement_times import changes_since, earlier_changes
from npdr_ppl.engines.common.past_motion import PastMotion
from npdr_ppl.engines.common.sensor_effects import SensorEffects
from npdr_ppl.language.effects import ActionEffect, Commands, Effect, SensorEffect
from npdr_ppl.language.simulator import Simulator

__all__ = ["EffectChain", "needed_histories"]

# Lengths of histories are rounded up to multiples of this number of steps, so that different draws
# of a delay share a compiled kernel.
_HISTORY_GRAIN = 4


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
        force_step: Seconds between two evaluations of the force effects; ``None`` for
            ``time_step``.
        rate_lag: By which share of a step velocities are behind the positions' derivative;
            ``None`` if it is unknown.

    Attributes:
        forces: The effects on forces.
        actions: The effects on commands.
        sensors: The effects on measurements.
    """

    def __init__(
        self,
        simulator: Simulator,
        joints: tuple[str, ...],
        time_step: float,
        histories: tuple[int, ...],
        *,
        force_step: float | None = None,
        rate_lag: float | None = None,
    ) -> None:
        self.simulator = simulator
        self.joints = joints
        self.time_step = time_step
        self.histories = histories
        self.forces = ForceEffects(
            simulator, joints, time_step if force_step is None else force_step
        )
        self.actions = ActionEffects(simulator, histories, time_step)
        of_sensors = histories[len(self.actions.effects) :]
        self.sensors = SensorEffects(simulator, of_sensors, time_step, rate_lag)

    @property
    def position_channels(self) -> tuple[str | None, ...]:
        """Name of the state that is each joint's position, ``None`` if it is no state."""
        return tuple(state.name for state in self.simulator.states)

    @property
    def channels_with_past(self) -> tuple[str | None, ...]:
        """The same; ``None`` also where no force effect needs the motion before a segment."""
        joints = {joint for _, effect, joint in self.forces.effects if effect.needs_past}
        names = self.position_channels if joints else ()
        return tuple(name if joint in joints else None for joint, name in enumerate(names))

    @property
    def num_parts(self) -> int:
        """In how many parts of a step late measurements are moved to the present.

        They must be so short that the fastest damping is followed.
        """
        return 1

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
        is_held: Tensor | None = None,
        earlier: Sequence[Components] = (),
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
            is_held: Where the robot did not move before, ``(N,)``; ``None`` for nowhere.
            earlier: Positions, then velocities one step before, two steps before and so on, as far
                as effects on sensors need them; empty to compute them from those at the start.
        """
        begun = time - num_past * self.time_step
        joint_positions, joint_velocities = positions, velocities
        if self.forces.effects:
            joint_positions, joint_velocities = self.at_joints(positions, velocities)
        return State(
            positions,
            velocities,
            self.forces.initial_memory(
                joint_positions, joint_velocities, tables, time, past_motion or PastMotion()
            ),
            self.actions.initial_memory(commands, tables, begun),
            self.actions.initial_past(commands),
            *self._sensor_memory(
                positions,
                velocities,
                tables,
                commands_before or (lambda _: commands),
                readings,
                time,
                is_held,
                earlier,
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
        is_held: Tensor | None,
        earlier: Sequence[Components],
    ) -> tuple[tuple[tuple[Any, ...], ...], tuple[Components, ...]]:
        """Returns the sensor effects' own state, and past values; see :meth:`start`."""
        # Only values that an effect needs are computed, because short simulations start often.
        if not self.sensors.effects:
            return (), ()
        true = self.true_readings(positions, velocities, tables)
        changes: dict[int, tuple[Tensor, ...]] = {}
        if num_before := self.sensors.num_before:

            def accelerations(states: Components, step: int) -> Components:
                split = self.num_positions
                commands = commands_before(step)
                return self.accelerations(states[:split], states[split:], commands, tables)

            states = (*positions, *velocities)
            if earlier:
                changes = changes_since(self.simulator, states, earlier)
            else:
                changes = earlier_changes(
                    self.simulator, states, accelerations, self.time_step, num_before
                )
            if is_held is not None:
                changes = {
                    column: tuple(change.where(~is_held, 0.0) for change in own)
                    for column, own in changes.items()
                }
        memory = self.sensors.initial_memory(true, changes, readings, tables, time)
        return memory, self.sensors.initial_past(true, changes)

    def advance(
        self,
        state: State,
        commands: Components,
        tables: Tables,
        records: tuple[Commands, ...] | None = None,
    ) -> State:
        """Advances the state by one time step under commands; see :meth:`ActionEffects.act`."""
        state, actions, moments = self.actions.act(state, commands, tables, records)
        return self.move(state, actions, tables, moments)

    def read(self, state: State, tables: Tables) -> tuple[State, Components]:
        """Returns the state with the sensor effects' memory advanced, and the measurements."""
        true = self.true_readings(state.positions, state.velocities, tables)
        return self.sensors.report(state, true, tables)


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
