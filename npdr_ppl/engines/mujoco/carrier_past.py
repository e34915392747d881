"""How carriers swing as segments begin: second joints are simulated through the recorded past."""

from typing import NamedTuple

import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.stepper import MujocoStepper
from npdr_ppl.language.inputs import Inputs

__all__ = ["CarrierPast", "carrier_past"]

_SECONDS = 1.0
"""How long the past is simulated. A carrier alone with the priors' medians, a time constant of
18 ms and a damping ratio of 0.1, keeps 6 % of its swing for so long."""

_SIDE = 2
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

    def settle(
        self,
        chain: MujocoStepper,
        state: State,
        tables: Tables,
        commands: Tensor,
        present: Components,
    ) -> None:
        """Places second joints as they are after the past, in position and velocity.

        Each simulation begins with springs in balance, goes through its past from the recorded
        state, and is then put into the state at the start of its segment. Its second joints stay
        as they are. Effects with a state begin the past with that of the segment's start, and
        measurements of the past count as exact: what a carrier does follows from forces, which
        such errors change little.

        Args:
            chain: The simulations, in the state at the start of the segments.
            state: The state of the effects there.
            tables: Constants of the simulation.
            commands: Actions after all effects in the past steps and the first step of the
                segment, ``(N, num_steps + 1, engine steps per step or 1, actions)``.
            present: State of the simulator at the start of the segments, ``(N,)`` per component.
        """
        # Rollouts that began within the past join when their first step is due.
        joining = [int(length) for length in self.lengths.unique().flip(0)]
        past = state
        for length, following in zip(joining, (*joining[1:], 0), strict=True):
            joins = self.lengths == length
            before = self.states if length else present
            chain.place(before, joins)
            first = commands[:, self.num_steps - length, 0].unbind(-1)
            chain.settle(past, tables, first, joins)
            for step in range(self.num_steps - length, self.num_steps - following):
                parts = commands[:, step].unbind(1)
                past = chain.follow(past, [part.unbind(-1) for part in parts], tables)
        chain.place(present)


def carrier_past(simulator: MujocoMechanism, inputs: Inputs, shape: torch.Size) -> CarrierPast:
    """Returns from where the past of segments is simulated.

    The past begins half a second before a segment, or with its rollout. The state there is that of
    a parabola through five measurements, where something was measured.

    Args:
        simulator: The simulator with its effects.
        inputs: The segments.
        shape: Shape of the batch and the segments, of numel N.
    """

    def spread(value: Tensor) -> Tensor:
        return value.expand(shape).reshape(-1)

    states = simulator.initial_states(inputs)
    if not simulator.second_joints or inputs.recorded_readings is None:
        return CarrierPast(0, spread(torch.zeros_like(inputs.start)), tuple(map(spread, states)))
    most = min(round(_SECONDS / inputs.time_step), inputs.past_actions.shape[-2])
    lengths = inputs.start.clamp_max(most)
    begin = inputs.start - lengths
    last = inputs.recorded_readings.shape[1] - 1
    middle = begin.clamp(min=_SIDE).clamp(max=max(_SIDE, last - _SIDE))
    offset = torch.arange(-_SIDE, _SIDE + 1, dtype=torch.float64)
    parabola = torch.linalg.pinv(torch.stack((offset**0, offset, offset**2), dim=1))
    late = (begin - middle).double()
    one = torch.ones_like(late)
    # What the five measurements count in the value and in the rate, (5, S) each.
    counts = [
        (torch.stack(terms, dim=1) @ parabola).T
        for terms in ((one, late, late**2), (0.0 * one, one, 2.0 * late))
    ]
    steps = inputs.start - middle - offset[:, None].long()
    found = []
    for channel, value in zip(simulator.states, states, strict=True):
        # A measured rate needs no derivative.
        for name, order in ((channel.name, 0), (channel.rate_of, 1)):
            readings = inputs.earlier(name or "", steps)
            if readings is not None:
                value = (counts[order] * readings).sum(0) / inputs.time_step**order
                break
        found.append(spread(value))
    return CarrierPast(int(lengths.max()), spread(lengths), tuple(found))
