"""One step of a mechanical system with its effects: what open and closed loop share."""

from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.engines.commands import RecentCommands
from npdr_ppl.engines.compilation import signature
from npdr_ppl.engines.drive import drive_forces, inverse_inertia
from npdr_ppl.engines.dry_friction import solve_dry_friction
from npdr_ppl.engines.integrators import Components
from npdr_ppl.engines.reading_times import sensor_rates
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import ActionEffect, Commands, ForceEffect, SensorEffect

if TYPE_CHECKING:
    from npdr_ppl.engines.ode import ODESimulator

__all__ = ["State", "Stepper", "Tables", "flatten"]

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


class Stepper:
    """Advances states by one time step under the effects attached to a simulator.

    Args:
        simulator: The system and its effects.
        time_step: Seconds per step.
        histories: Past commands that each action effect may ask for, then past values of each
            sensor effect; see :meth:`needed_histories`.
    """

    def __init__(
        self, simulator: "ODESimulator", time_step: float, histories: tuple[int, ...]
    ) -> None:
        self.simulator = simulator
        self.time_step = time_step
        self.histories = histories
        self._substep = time_step / simulator.substeps
        actions = [channel.name for channel in simulator.actions]
        sensors = [channel.name for channel in simulator.sensors]
        # Each entry: place in Tables.effects, the effect, what it acts on.
        self.force_effects: list[tuple[int, ForceEffect, int]] = []
        self.action_effects: list[tuple[int, ActionEffect, int]] = []
        self.sensor_effects: list[tuple[int, SensorEffect, tuple[int, ...]]] = []
        for place, effect in enumerate(simulator.effects):
            if isinstance(effect, ForceEffect):
                joint = simulator.joints.index(effect.port)
                self.force_effects.append((place, effect, joint))
            elif isinstance(effect, ActionEffect):
                self.action_effects.append((place, effect, actions.index(effect.port)))
            elif isinstance(effect, SensorEffect):
                port = simulator.port(effect.port)
                channels = sensors if port.kind == "clock" else port.channels
                columns = tuple(sensors.index(name) for name in channels)
                self.sensor_effects.append((place, effect, columns))
        self._needs_joints = any(effect.needs_joint for _, effect, _ in self.force_effects)

    @property
    def signature(self) -> Hashable:
        """Equal for steppers that compile to the same code."""
        return signature(self.simulator), self.time_step, self.histories

    @staticmethod
    def needed_histories(
        simulator: "ODESimulator", effects: tuple[Mapping[str, Tensor], ...], time_step: float
    ) -> tuple[int, ...]:
        """Returns how much of the past action and then sensor effects ask for, rounded up."""
        needed = [
            effect.history(effects[place], time_step)
            for kind in (ActionEffect, SensorEffect)
            for place, effect in enumerate(simulator.effects)
            if isinstance(effect, kind)
        ]
        return tuple(-(-number // _HISTORY_GRAIN) * _HISTORY_GRAIN for number in needed)

    def start(
        self,
        positions: Components,
        velocities: Components,
        tables: Tables,
        commands: Components,
        readings: tuple[Tensor | None, ...],
        time: Tensor,
        num_past: int = 0,
    ) -> State:
        """Returns the state at the start of an episode or segment.

        Args:
            positions: Positions, ``(N,)`` each.
            velocities: Velocities, ``(N,)`` each.
            tables: Constants of the simulation.
            commands: What each action channel saw for long before the start, ``(N,)`` each.
            readings: What each sensor reported at the start, ``(N,)`` each; ``None`` for the
                true value.
            time: Seconds since the rollout began, ``(N,)``.
            num_past: Steps before the start that the action effects are to be taken through.
        """
        rates: dict[int, tuple[Tensor, ...]] = {}
        if any(effect.needs_rates for _, effect, _ in self.sensor_effects):
            rates = sensor_rates(self.simulator, positions, velocities, commands, tables.constants)

        def start(place: int, time_step: float, history: int = 0, sensor: int = -1) -> Start:
            known = rates.get(sensor, ())
            return Start(time, time_step, tables.effects[place], history, known)

        earlier = time - num_past * self.time_step

        true = self.simulator.readings(positions, velocities, tables.constants)
        reported = [
            value if read is None else read for value, read in zip(true, readings, strict=True)
        ]
        return State(
            positions,
            velocities,
            tuple(
                effect.initial_memory(
                    positions[joint], velocities[joint], start(place, self._substep)
                )
                for place, effect, joint in self.force_effects
            ),
            tuple(
                effect.initial_memory(
                    commands[channel],
                    start(place, self.time_step, length)._replace(time=earlier),
                )
                for (place, effect, channel), length in zip(
                    self.action_effects, self.histories, strict=False
                )
            ),
            tuple(
                (commands[channel],) * length
                for (_, _, channel), length in zip(
                    self.action_effects, self.histories, strict=False
                )
            ),
            tuple(
                tuple(
                    effect.initial_memory(
                        true[c], reported[c], start(place, self.time_step, length, c)
                    )
                    for c in columns
                )
                for (place, effect, columns), length in zip(
                    self.sensor_effects, self.histories[len(self.action_effects) :], strict=True
                )
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

    def move(self, state: State, actions: Components, tables: Tables) -> State:
        """Advances the dynamics by one time step under constant actions."""
        for _ in range(self.simulator.substeps):
            state = self._move_once(state, actions, tables)
        return state

    def read(self, state: State, tables: Tables) -> tuple[State, Components]:
        """Returns the state with the sensor effects' memory advanced, and the readings."""
        readings = list(
            self.simulator.readings(state.positions, state.velocities, tables.constants)
        )
        if not self.sensor_effects:
            return state, tuple(readings)
        memories = []
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

    def _move_once(self, state: State, actions: Components, tables: Tables) -> State:
        """Advances the dynamics by one substep."""
        if self._needs_joints:
            state = self._begin_step(state, actions, tables)
        simulator, constants = self.simulator, tables.constants
        start = state.positions, state.velocities
        dry: tuple[Any, ...] = (0.0,) * len(state.positions)

        def acceleration(positions: Components, velocities: Components) -> Components:
            forces = self._forces(positions, velocities, state, tables, dry)
            return simulator.accelerations(positions, velocities, actions, forces, constants)

        first = acceleration(*start)
        bounds = self._dry_friction_bounds(state, tables)
        has_dry_friction = any(bound is not None for bound in bounds)
        if has_dry_friction:
            forces = self._forces(*start, state, tables, dry)
            inertia = inverse_inertia(simulator, *start, actions, forces, constants, first)
            dry = solve_dry_friction(bounds, state.velocities, first, inertia, self._substep)
            # Accelerations are affine in the forces, so the first evaluation is not repeated.
            first = tuple(
                a + sum(w * f for w, f, b in zip(row, dry, bounds, strict=True) if b is not None)
                for a, row in zip(first, inertia, strict=True)
            )
        q, v = simulator.integrator.step(acceleration, *start, first, self._substep)
        if has_dry_friction:
            # Friction within its bound has stopped the joint; rounding must not leave a velocity
            # whose sign then means something to a policy.
            v = tuple(
                vi if b is None else torch.where(f.abs() < b, 0.0, vi)
                for vi, f, b in zip(v, dry, bounds, strict=True)
            )
        memory = tuple(
            effect.next_memory(
                state.positions[joint],
                state.velocities[joint],
                tables.effects[place],
                state.force_memory[k],
                self._substep,
            )
            for k, (place, effect, joint) in enumerate(self.force_effects)
        )
        return state._replace(positions=q, velocities=v, force_memory=memory)

    def _begin_step(self, state: State, actions: Components, tables: Tables) -> State:
        """Shows the joints to the force effects that ask for them."""
        simulator, constants = self.simulator, tables.constants
        q, v = state.positions, state.velocities
        forces = self._forces(q, v, state, tables, (0.0,) * len(q), before_step=True)
        acceleration = simulator.accelerations(q, v, actions, forces, constants)
        inertia = inverse_inertia(simulator, q, v, actions, forces, constants, acceleration)
        drive = drive_forces(simulator, q, v, actions, forces, constants, acceleration, inertia)
        memory = list(state.force_memory)
        for k, (place, effect, i) in enumerate(self.force_effects):
            if effect.needs_joint:
                joint = Joint(q[i], v[i], acceleration[i], inertia[i][i], drive[i])
                memory[k] = effect.begin_step(
                    joint, tables.effects[place], memory[k], self._substep
                )
        return state._replace(force_memory=tuple(memory))

    def _forces(
        self,
        positions: Components,
        velocities: Components,
        state: State,
        tables: Tables,
        dry: tuple[Any, ...],
        *,
        before_step: bool = False,
    ) -> tuple[Any, ...]:
        """Returns the smooth forces in a state of the integrator, on top of the dry ones.

        Before a step has begun, without the effects that have not seen their joint yet.
        """
        forces = list(dry)
        for k, (place, effect, joint) in enumerate(self.force_effects):
            if before_step and effect.needs_joint:
                continue
            force = effect.force(
                positions[joint], velocities[joint], tables.effects[place], state.force_memory[k]
            )
            if force is not None:
                forces[joint] = forces[joint] + force
        return tuple(forces)

    def _dry_friction_bounds(self, state: State, tables: Tables) -> tuple[Tensor | None, ...]:
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


def flatten(tree: Any, shape: torch.Size, *, expand: bool = False) -> Any:
    """Returns the tree with every tensor expanded to ``shape`` and flat.

    One flat axis vectorises well whatever the batch's shape is.

    Args:
        tree: Nested tuples and dictionaries of tensors that broadcast to ``shape``.
        shape: The batch's shape.
        expand: Whether to expand single numbers too: a compiled kernel should not depend on which
            parameters happen to vary.
    """

    def flat(leaf: Tensor) -> Tensor:
        if leaf.numel() == 1 and not expand:
            return leaf.reshape(())
        # A single number expands to a view with stride 0, which would be a kernel of its own.
        return leaf.expand(shape).reshape(-1).contiguous()

    return pytree.tree_map_only(Tensor, flat, tree)
