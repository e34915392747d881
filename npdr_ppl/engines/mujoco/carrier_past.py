"""How carriers swing as segments begin: second joints are simulated through the recorded past."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.past_motion import PastMotion
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.stepper import MujocoStepper
from npdr_ppl.language.inputs import Inputs

__all__ = ["CarrierPast", "carrier_past"]

_SECONDS = 1.0
"""How long the past is simulated. On an arm whose carrier swings for seconds, an eighth of the
error of carriers that begin at rest is left (``tests/engines/test_second_joints.py``)."""

_SAMPLES_PER_SIDE = 2
"""Samples on each side of a moment, from which its state is estimated."""


class CarrierPast(NamedTuple):
    """From where the past of segments is simulated; N simulations.

    Attributes:
        num_steps: Greatest number of past control steps.
        lengths: Number of each simulation's past steps, ``(N,)``.
        states: State of the simulator before these steps, ``(N,)`` per component.
    """

    num_steps: int
    lengths: Tensor
    states: Components

    def part(self, first: int, last: int) -> "CarrierPast":
        """Returns the data of some of the N simulations."""
        return CarrierPast(
            self.num_steps,
            self.lengths[first:last],
            tuple(state[first:last] for state in self.states),
        )

    def replay(
        self,
        chain: MujocoStepper,
        state: State,
        tables: Tables,
        commands: Tensor,
        segment_start: Components,
        time: Tensor,
    ) -> None:
        """Places second joints as they are after the past, in position and velocity.

        Each simulation begins with springs in balance, goes through its past from the recorded
        state, and is then put into the state at the start of its segment. Its second joints stay
        as they are; those of simulations that diverge in the past rest in balance. Effects inside
        servos begin the past with their state at the segment's start, and measurements of the past
        count as exact: what a carrier does follows from forces, which such errors change little.

        Args:
            chain: The simulations.
            state: The state of the effects at the start of the segments.
            tables: Constants of the simulation.
            commands: Actions after all effects in the past steps and the first step of the
                segment, ``(N, num_steps + 1, engine steps per step or 1, actions)``.
            segment_start: State of the simulator at the start of the segments, ``(N,)`` per
                component.
            time: Seconds from the start of the rollout to that of the segment, ``(N,)``.
        """
        # Rollouts that began within the past join when their first step is due.
        joining = [int(length) for length in self.lengths.unique().flip(0)]
        past = state
        for length, following in zip(joining, (*joining[1:], 0), strict=True):
            joins = self.lengths == length
            chain.restart(self.states if length else segment_start, joins)
            begin = state
            if length:
                earlier = time - length * chain.time_step
                at_joints = chain.at_joints((), ())
                memory = chain.forces.initial_memory(*at_joints, tables, earlier, PastMotion())
                begin = state._replace(force_memory=memory)
            past = state._replace(
                force_memory=_where(joins, begin.force_memory, past.force_memory),
                servo_memory=_where(joins, begin.servo_memory, past.servo_memory),
            )
            first = self.num_steps - length
            chain.settle(past, tables, commands[:, first, 0].unbind(-1), joins)
            for step in range(first, self.num_steps - following):
                parts = commands[:, step].unbind(1)
                past = chain.follow(past, [part.unbind(-1) for part in parts], tables)
        lost = chain.is_lost.clone()
        chain.restart(segment_start)
        chain.settle(state, tables, commands[:, -1, 0].unbind(-1), lost)


def carrier_past(
    simulator: MujocoMechanism, inputs: Inputs, shape: torch.Size, states: Components
) -> CarrierPast:
    """Returns from where the past of segments is simulated.

    The past begins a second before a segment, with its rollout, or with the oldest command of
    ``past_actions``, whichever is latest. The state there is that of a parabola through five
    measurements. A component that was not measured has its value at the segment's start. Without
    recorded measurements there is no past, so that carriers begin at rest.

    Args:
        simulator: The simulator with its effects.
        inputs: The segments.
        shape: Shape of the batch and the segments, of numel N.
        states: State of the simulator at the start of the segments, ``(N,)`` per component.
    """
    if not simulator.second_joints or inputs.recorded_readings is None:
        return CarrierPast(0, torch.zeros(shape.numel(), dtype=torch.long), states)
    most = min(round(_SECONDS / inputs.time_step), inputs.past_actions.shape[-2])
    lengths = inputs.start.clamp_max(most)
    measured = _smoothed(inputs, inputs.start - lengths)
    found = []
    for channel, value in zip(simulator.states, states, strict=True):
        # A measured rate needs no derivative.
        for place in ((channel.name, 0), (channel.rate_of, 1)):
            if place in measured:
                value = measured[place].expand(shape).reshape(-1)
                break
        found.append(value)
    return CarrierPast(int(lengths.max()), lengths.expand(shape).reshape(-1), tuple(found))


def _smoothed(inputs: Inputs, begin: Tensor) -> dict[tuple[str | None, int], Tensor]:
    """Returns the value (0) and the rate (1) of each channel at a step of each segment's rollout.

    Args:
        inputs: The segments.
        begin: The steps, ``(S,)``.

    Returns:
        By channel and order of the derivative, ``(S,)`` each.
    """
    assert inputs.recorded_readings is not None
    side, num = _SAMPLES_PER_SIDE, inputs.recorded_readings.shape[1]
    # Near the ends of a rollout, the parabola's middle is another step.
    middle = begin.clamp(side, max(side, num - 1 - side))
    from_middle = (begin - middle).double()
    offsets = torch.arange(-side, side + 1, dtype=torch.float64)
    coefficients = torch.linalg.pinv(torch.stack((offsets**0, offsets, offsets**2), dim=1))
    one, zero = torch.ones_like(from_middle), torch.zeros_like(from_middle)
    terms = (one, from_middle, from_middle**2), (zero, one, 2.0 * from_middle)
    steps = inputs.start - middle - offsets[:, None].long()
    found: dict[tuple[str | None, int], Tensor] = {}
    for name in inputs.channel_names:
        readings = inputs.earlier(name, steps)
        for order, term in enumerate(terms):
            weights = (torch.stack(term, dim=1) @ coefficients).T
            found[name, order] = (weights * readings).sum(0) / inputs.time_step**order
    return found


def _where(rows: Tensor, new: Any, old: Any) -> Any:
    """Returns the nested tuples ``new`` in some rows of their tensors, and ``old`` elsewhere."""
    if isinstance(new, Tensor):
        return torch.where(rows, new, old)
    if isinstance(new, tuple):
        parts = [_where(rows, own, other) for own, other in zip(new, old, strict=True)]
        return type(new)(*parts) if hasattr(new, "_fields") else tuple(parts)
    return new
