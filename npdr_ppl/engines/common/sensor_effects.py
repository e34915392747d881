"""The sensor effects of a simulator: what becomes of true values before they are measured."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from npdr_ppl.engines.common.bends import Bends
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import SensorEffect
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
        self._needs_bends = any(effect.needs_bend for _, effect, _ in self.effects)
        self._bends = Bends(simulator, time_step, rate_lag)
        self._histories = histories
        self._time_step = time_step

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
            bends = self._bends.before(column, changes)[:length] if effect.needs_bend else ()
            return Start(time, self._time_step, own, length, known, bends)

        return tuple(
            tuple(
                effect.initial_memory(
                    true[c],
                    true[c] if (reported := readings[c]) is None else reported,
                    start(place, effect, length, c),
                )
                for c in columns
            )
            for (place, effect, columns), length in zip(self.effects, self._histories, strict=True)
        )

    def initial_past(
        self, true: Components, changes: Mapping[int, tuple[Tensor, ...]]
    ) -> tuple[Components, ...]:
        """Returns the true values at the start and one step earlier, if an effect needs them.

        Args:
            true: True value of each sensor at the start, ``(N,)`` each.
            changes: See :meth:`initial_memory`; without them, nothing moved.
        """
        if not self._needs_bends:
            return ()
        earlier = tuple(
            value + changes[column][0] if changes.get(column) else value
            for column, value in enumerate(true)
        )
        return true, earlier

    def report(self, state: State, true: Components, tables: Tables) -> tuple[State, Components]:
        """Passes the true values of one step through the effects.

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
        for (place, effect, columns), memory in zip(
            self.effects, state.sensor_memory, strict=True
        ):
            changed = list(memory)
            for m, column in enumerate(columns):
                own = tables.effects[place]
                if effect.needs_bend:
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
