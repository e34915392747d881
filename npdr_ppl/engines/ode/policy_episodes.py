"""Closed-loop episodes of batches of policies in batches of simulated domains."""

import torch

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.compilation import is_worthwhile, steps_per_call, with_fallback
from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.common.policy_loop import LoopBody, begin, run_compiled, run_eagerly
from npdr_ppl.engines.ode.mechanical_system import MechanicalSystem
from npdr_ppl.engines.ode.stepping import Stepper

__all__ = ["roll_out"]


def roll_out(simulator: MechanicalSystem, request: EpisodeRequest) -> Episodes:
    """Simulates episodes of policies in domains; see :class:`EpisodeRequest`."""
    reward, num_steps, step = request.reward, request.num_steps, request.time_step
    initial_states = request.initial_states
    dtype = simulator.common_dtype(request.parameters, initial_states)
    dtype = torch.promote_types(dtype, request.policy.parameters.dtype)
    device = initial_states.device
    policy, domain, shape = request.batch(simulator, dtype, device)
    mode = request.compile or simulator.compile
    size = {
        "num_steps": num_steps,
        "batch_size": shape.numel(),
        "expected_calls": request.expected_calls,
    }
    is_compiled = not request.record and is_worthwhile(mode, device, **size)

    def run(is_compiled: bool) -> Episodes:
        middle = torch.tensor(0.5 * num_steps * step, dtype=dtype, device=device)
        present = simulator.changed(domain, middle)
        tables, histories = simulator.tables(present, shape, step, expand=is_compiled)
        constants = flatten(policy.constants(request.believed(domain)), shape, expand=is_compiled)
        stepper = Stepper(simulator, step, histories)
        body = LoopBody(stepper, policy, reward, steps_per_call(**size))
        states = flatten(initial_states.to(dtype).unbind(-1), shape, expand=True)
        loop = begin(body, states, tables)
        if not is_compiled:
            return run_eagerly(body, loop, tables, constants, num_steps, shape, request.record)
        return run_compiled(body, loop, tables, constants, num_steps, shape)

    return with_fallback(mode, is_compiled, run)
