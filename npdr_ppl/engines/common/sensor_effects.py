"""The sensor effects of a simulator: what becomes of true values before they are measured."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.engines.common.bends import Bends
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import BentSensorEffect, SensorEffect
from npdr_ppl.language.simulator import Simulator

__all__ = ["SensorEffects"]


class SensorEffects:
    """Passes true values through the effects on them, one after the other.

    Args:
        simulator: The system and its effects.
        histories: Number of past values that each effect may need.
        time_step: Seconds per step.
        rate_lag: See :class:`~npdr_ppl.engines.common.bends.Bends`.

    Attributes:
        effects: Index in ``Tables.effects``, effect and sensor channels of each effect.
    """

    def __init__(
        self,
        simulator: Simulator,
        histories: tuple[int, ...],
        time_step: float,
        rate_lag: float | None,
    ) -> None:
        sensors = [channel.name for channel in simulator.sensors]
        self.effects: list[tuple[int, SensorEffect, tuple[int, ...]]] = []
        for place, effect in enumerate(simulator.effects):
            if isinstance(effect, SensorEffect):
                port = simulator.port(effect.port)
                channels = sensors if port.kind == "clock" else port.channels
                columns = tuple(sensors.index(name) for name in channels)
                self.effects.append((place, effect, columns))
        self._is_later = self._later_bends()
        self._needs_bends = any(
            isinstance(effect, BentSensorEffect) for _, effect, _ in self.effects
        )
        self._bends = Bends(simulator, time_step, rate_lag)
        self._simulator = simulator
        self._histories = histories
        self._time_step = time_step

    def _later_bends(self) -> list[tuple[bool, ...]]:
        """Returns for each effect and channel whether an earlier effect changed its bend."""
        changed: set[int] = set()
        result = []
        for _, effect, columns in self.effects:
            result.append(
                tuple(isinstance(effect, BentSensorEffect) and c in changed for c in columns)
            )
            changed |= set(columns) if isinstance(effect, BentSensorEffect) else set()
        return result

    @property
    def num_before(self) -> int:
        """For how many steps before a start :meth:`initial_memory` needs the true values."""
        pairs = zip(self.effects, self._histories, strict=True)
        return max((length for (_, effect, _), length in pairs if effect.needs_past), default=0)

    def initial_memory(
        self,
        true: Components,
        changes: Mapping[int, tuple[Tensor, ...]],
        readings: tuple[Tensor | None, ...],
        tables: Tables,
        time: Tensor,
    ) -> tuple[tuple[Any, ...], ...]:
        """Returns the effects' own state at the start of an episode or segment.

        Args:
            true: True value of each sensor at the start, ``(N,)`` each.
            changes: Differences of earlier true values from those at the start, latest first, by
                sensor.
            readings: Measurement of each sensor at the start; ``None`` for the true value.
            tables: Constants of the simulation.
            time: Seconds since the rollout began, ``(N,)``.
        """

        def start(place: int, effect: SensorEffect, length: int, column: int) -> Start:
            own, known = tables.effects[place], changes.get(column, ())[:length]
            bends = (
                self._bends.before(column, changes)[:length]
                if isinstance(effect, BentSensorEffect)
                else ()
            )
            return Start(time, self._time_step, own, length, known, bends)

        def memory(
            place: int, effect: SensorEffect, length: int, column: int, is_later: bool
        ) -> Any:
            reading = true[column] if (reported := readings[column]) is None else reported
            own = effect.initial_memory(
                true[column], reading, start(place, effect, length, column)
            )
            if not is_later:
                return own
            unknown = torch.full_like(true[column], math.nan)
            return own, unknown, unknown

        effects = zip(self.effects, self._histories, self._is_later, strict=True)
        return tuple(
            tuple(
                memory(place, effect, length, column, is_later)
                for column, is_later in zip(columns, later, strict=True)
            )
            for (place, effect, columns), length, later in effects
        )

    def initial_past(
        self, true: Components, changes: Mapping[int, tuple[Tensor, ...]]
    ) -> tuple[Components, ...]:
        """Returns the true values at the start and one step earlier, if an effect needs them.

        Args:
            true: True value of each sensor at the start, ``(N,)`` each.
            changes: See :meth:`initial_memory`; earlier values are NaN where they are unknown.
        """
        if not self._needs_bends:
            return ()
        states = {state.name for state in self._simulator.states}
        earlier = tuple(
            value + changes[column][0]
            if changes.get(column) and sensor.name in states
            else torch.full_like(value, math.nan)
            for column, (sensor, value) in enumerate(
                zip(self._simulator.sensors, true, strict=True)
            )
        )
        return true, earlier

    def report(self, state: State, true: Components, tables: Tables) -> tuple[State, Components]:
        """Passes the true values of one step through the effects.

        The bend of a true value is not that of a late or filtered one. A later effect therefore
        gets the bend of its own last inputs.

        Args:
            state: State after the step.
            true: True value of each sensor, ``(N,)`` each.
            tables: Constants of the simulation.

        Returns:
            The state with the effects' memory advanced, and the measurements.
        """
        if not self.effects:
            return state, true
        readings, memories = list(true), []
        for (place, effect, columns), memory, later in zip(
            self.effects, state.sensor_memory, self._is_later, strict=True
        ):
            changed = list(memory)
            for m, column in enumerate(columns):
                own = tables.effects[place]
                if later[m] and isinstance(effect, BentSensorEffect):
                    kept, *inputs = memory[m]
                    present = readings[column]
                    bend = self._bends.of_three(column, present, *inputs)
                    # An earlier effect of no strength changes nothing.
                    same = self._bends.within(column, true, *state.past_readings)
                    bend = torch.where(present == true[column], same, bend)
                    readings[column], kept = effect.read_bent(
                        present, bend, own, kept, self._time_step
                    )
                    changed[m] = kept, present, inputs[0]
                elif isinstance(effect, BentSensorEffect):
                    bend = self._bends.within(column, true, *state.past_readings)
                    readings[column], changed[m] = effect.read_bent(
                        readings[column], bend, own, memory[m], self._time_step
                    )
                else:
                    readings[column], changed[m] = effect.read(
                        readings[column], own, memory[m], self._time_step
                    )
            memories.append(tuple(changed))
        past = (true, state.past_readings[0]) if self._needs_bends else ()
        state = state._replace(sensor_memory=tuple(memories), past_readings=past)
        return state, tuple(readings)
