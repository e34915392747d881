"""Closed loop in MuJoCo: batches of policies in batches of simulated domains."""

from dataclasses import replace

import torch

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.common.policy_loop import LoopBody, begin, run_eagerly
from npdr_ppl.engines.mujoco.batches import quiet
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.stepper import MujocoStepper

__all__ = ["roll_out"]


def roll_out(simulator: MujocoMechanism, request: EpisodeRequest) -> Episodes:
    """Simulates episodes of policies in domains; see :class:`EpisodeRequest`."""
    num_steps, step = request.num_steps, request.time_step
    given = {n: torch.as_tensor(x).detach().double() for n, x in request.parameters.items()}
    request = replace(request, parameters=given)
    policy, domain, shape = request.batch(simulator, torch.float64, torch.device("cpu"))
    flat = flatten(given, shape)
    constants = flatten(policy.constants(request.believed(domain)), shape)
    states = flatten(request.initial_states.double().unbind(-1), shape, expand=True)
    with quiet():
        middle = torch.tensor(0.5 * num_steps * step, dtype=torch.float64)
        batch, tables = simulator.make_batch(flat, shape.numel(), step, middle)
        stepper = MujocoStepper(simulator, batch, step, simulator.histories(flat, step))
        stepper.place(states)
        stepper.begin()
        body = LoopBody(stepper, policy, request.reward)
        loop = begin(body, states, tables)
        return run_eagerly(body, loop, tables, constants, num_steps, shape, request.record)
