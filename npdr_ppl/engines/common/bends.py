"""How the true values of sensors move within a step.

Commands are constant within a step, so that motions are smooth there, and have kinks between
steps. A value goes from x₀ to x₁ along

    x(s) = (1 − s) x₀ + s x₁ + s (1 − s) b,  s from 0 to 1,

with a bend b, which is four times the deviation from the straight line at the middle of the step;
for a constant acceleration a, it is −½ a h². If the rate is a channel, too, a position's bend is
½ h (v₀ − v₁). A rate's bend is chosen so that its integral over the step is the change of the
position.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.language.simulator import Simulator

__all__ = ["Bends"]


class Bends:
    """Computes the bends of sensor channels.

    Args:
        simulator: The system.
        time_step: Seconds per step.
        rate_lag: By which share of a step velocities are behind the positions' derivative;
            ``None`` if it is unknown. Velocities then move on straight lines.
    """

    def __init__(self, simulator: Simulator, time_step: float, rate_lag: float | None) -> None:
        columns = {sensor.name: column for column, sensor in enumerate(simulator.sensors)}
        self._rates: dict[int, int | None] = {}
        """For each channel that is a rate the channel of its position."""
        self._positions: dict[int, int] = {}
        """For each position the channel of its rate."""
        for state, is_rate in zip(simulator.states, simulator.is_rate, strict=True):
            column, position = columns.get(state.name), columns.get(state.rate_of or "")
            if column is not None and is_rate:
                self._rates[column] = position
                if position is not None:
                    self._positions[position] = column
        self._time_step, self._rate_lag = time_step, rate_lag

    def within(
        self, column: int, present: Components, last: Components, previous: Components
    ) -> Tensor:
        """Returns the bend of a channel in a step, ``(N,)``.

        If the rate of a position is no channel, the bend is that of :meth:`of_three`. If the
        position of a rate is no channel, the bend is zero.

        Args:
            column: The channel.
            present: True value of each channel after the step, ``(N,)`` each.
            last: The same before the step.
            previous: The same one step earlier.
        """
        h, change = self._time_step, present[column] - last[column]
        if column in self._positions:
            rate = self._positions[column]
            return 0.5 * h * (last[rate] - present[rate])
        if column not in self._rates:
            return self.of_three(column, present[column], last[column], previous[column])
        position, lag = self._rates[column], self._rate_lag
        if position is None or lag is None:
            return torch.zeros_like(change)
        mean = last[column] + (0.5 + lag) * change
        return 6.0 * ((present[position] - last[position]) / h - mean)

    def of_three(self, column: int, present: Tensor, last: Tensor, previous: Tensor) -> Tensor:
        """Returns the bend of the parabola through three values of a channel; 0 for a rate.

        Rates have kinks between steps.

        Args:
            column: The channel.
            present: Value after the step, ``(N,)``.
            last: Value before it.
            previous: Value one step earlier; NaN if it is unknown, for which the bend is 0.
        """
        if column in self._rates:
            return torch.zeros_like(present)
        return (0.5 * (2.0 * last - previous - present)).nan_to_num(0.0)

    def before(self, column: int, changes: Mapping[int, tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Returns the bends of a channel in the steps before a start, latest first.

        Args:
            column: The channel.
            changes: Differences of earlier true values from those at the start, latest first, by
                channel. Accelerations are taken as constant in each step, so that rates have no
                bend there.
        """
        own = changes.get(column, ())
        if column in self._rates:
            return tuple(torch.zeros_like(change) for change in own)
        rate = self._positions.get(column)
        if rate is not None:
            ends = (torch.zeros_like(changes[rate][0]), *changes[rate]) if own else ()
            half = 0.5 * self._time_step
            return tuple(half * (b - a) for a, b in zip(ends, ends[1:], strict=False))
        ends = (torch.zeros_like(own[0]), *own) if own else ()
        triples = zip(ends, ends[1:], ends[2:], strict=False)
        return tuple(0.5 * (2.0 * b - a - c) for a, b, c in triples)
