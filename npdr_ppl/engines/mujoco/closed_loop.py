"""Closed loop in MuJoCo: batches of policies in batches of domains."""

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from npdr_ppl.engines.closed_loop import (
    Episodes,
    FeedbackPolicy,
    LoopBody,
    Reward,
    begin,
    check_channels,
    run_eagerly,
)
from npdr_ppl.engines.mujoco.batches import quiet
from npdr_ppl.engines.mujoco.stepper import MujocoStepper
from npdr_ppl.engines.stepping import flatten

if TYPE_CHECKING:
    from npdr_ppl.engines.mujoco.simulator import MujocoSimulator

__all__ = ["roll_out"]


def roll_out(
    simulator: "MujocoSimulator",
    parameters: Mapping[str, Tensor],
    policy: FeedbackPolicy,
    initial_states: Tensor,
    num_steps: int,
    *,
    reward: Reward | None,
    time_step: float | None,
    record: bool,
) -> Episodes:
    """Simulates episodes of policies in domains; see :meth:`ClosedLoopSimulator.roll_out`."""
    simulator.check_parameters(parameters)
    check_channels(simulator, policy)
    step = time_step or simulator.time_step
    policy = copy.copy(policy)
    policy.parameters = policy.parameters.double()
    given = {name: torch.as_tensor(value).detach().double() for name, value in parameters.items()}
    domain = simulator.complete(given, torch.float64, torch.device("cpu"))
    shape = torch.broadcast_shapes(
        *(value.shape for value in domain.values()),
        policy.parameters.shape[:-1],
        initial_states.shape[:-1],
    )
    flat = flatten(given, shape)
    constants = flatten(policy.constants(domain), shape)
    states = flatten(initial_states.double().unbind(-1), shape, expand=True)
    with quiet():
        middle = torch.tensor(0.5 * num_steps * step, dtype=torch.float64)
        batch, tables = simulator.make_batch(flat, shape.numel(), step, middle)
        stepper = MujocoStepper(simulator, batch, step, simulator.histories(flat, step))
        stepper.place(states)
        stepper.begin()
        body = LoopBody(stepper, policy, reward)
        loop = begin(body, states, tables)
        return run_eagerly(body, loop, tables, constants, num_steps, shape, record)
