"""Batched simulation of mechanical systems whose accelerations are written in torch."""

import copy
import math
from collections.abc import Mapping
from typing import Self

import torch
from torch import Tensor

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.compilation import is_worthwhile, steps_per_call, with_fallback
from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.common.integrators import integrator
from npdr_ppl.engines.common.policy_loop import LoopBody, begin, run_compiled, run_eagerly
from npdr_ppl.engines.ode.declaration import check_accelerations
from npdr_ppl.engines.ode.mechanical_system import Forces, MechanicalSystem
from npdr_ppl.engines.ode.recorded_actions import replay
from npdr_ppl.engines.ode.stepping import Stepper
from npdr_ppl.language.inputs import Inputs

__all__ = ["Forces", "ODESimulator"]

FINER = "midpoint", "rk4"
"""Integrators of :meth:`ODESimulator.with_finer_steps`, in order of use. At the time steps of the
included models, the error of the first is a hundredth of that of an Euler step, which is mostly
negligible, and it takes half the time of the second."""

COARSER = "midpoint"
"""Integrator of :meth:`ODESimulator.with_coarser_steps`. On the Furuta pendulum of
``benchmarks/discovery.py`` (seed 0, steps of 2 ms), its derivatives by the parameters differ from
those of order four by less than 1e-3, and those of Euler steps by up to 3e-2."""

COARSER_SIMULATIONS = 10_000
"""Number of simulations of a segment from which on midpoint steps save time. Each step of a batch
costs about as much as 2000 simulations in it, measured with the same pendulum. Two further batches
are needed to find what midpoint steps miss."""


class ODESimulator(MechanicalSystem):
    """Simulates the system that a subclass declares; see :class:`MechanicalSystem`.

    Computations use the widest floating type among the given parameters and the inputs' actions,
    on the device of the actions.
    """

    is_finest: bool = False
    """Whether its steps cannot be refined further."""

    _is_checked: bool = False

    def with_finer_steps(self) -> Self | None:
        """Returns a copy with finer steps; ``None`` if there are none.

        It has the next integrator of higher order. If there is none, it has twice as many steps:
        a command that changes within a step counts with its mean, which no order improves.
        """
        if self.is_finest:
            return None
        changed = copy.copy(self)
        for finer in map(integrator, FINER):
            if finer.order > self.integrator.order:
                changed.integrator = finer
                return changed
        changed.substeps, changed.is_finest = 2 * self.substeps, True
        return changed

    def with_coarser_steps(
        self, num_simulations: float = math.inf, time_step: float | None = None
    ) -> Self | None:
        """Returns a copy with midpoint steps in place of Runge-Kutta steps of order four."""
        coarser = integrator(COARSER)
        if self.integrator.order <= coarser.order or num_simulations < COARSER_SIMULATIONS:
            return None
        changed = copy.copy(self)
        changed.integrator = coarser
        return changed

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions; see :meth:`Simulator.simulate`.

        Raises:
            ModelError: The accelerations ask for an unknown constant, or ignore a force.
        """
        if not self._is_checked:
            values = {name: value.to(inputs.actions) for name, value in self.nominal().items()}
            constants = self.constants(values, self.environment(values))
            check_accelerations(
                self, self.joints, self.accelerations, constants, inputs.actions.detach()
            )
            self._is_checked = True
        return replay(self, parameters, inputs)

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`roll_out`."""
        reward, num_steps, step = request.reward, request.num_steps, request.time_step
        initial_states = request.initial_states
        dtype = self.common_dtype(request.parameters, initial_states)
        dtype = torch.promote_types(dtype, request.policy.parameters.dtype)
        device = initial_states.device
        policy, domain, shape = request.batch(self, dtype, device)
        mode = request.compile or self.compile
        size = {
            "num_steps": num_steps,
            "batch_size": shape.numel(),
            "expected_calls": request.expected_calls,
        }
        is_compiled = not request.record and is_worthwhile(mode, device, **size)

        def run(is_compiled: bool) -> Episodes:
            middle = torch.tensor(0.5 * num_steps * step, dtype=dtype, device=device)
            present = self.changed(domain, middle)
            tables, histories = self.tables(present, shape, step, expand=is_compiled)
            constants = flatten(
                policy.constants(request.believed(domain)), shape, expand=is_compiled
            )
            stepper = Stepper(self, step, histories)
            body = LoopBody(stepper, policy, reward, steps_per_call(**size))
            states = flatten(initial_states.to(dtype).unbind(-1), shape, expand=True)
            loop = begin(body, states, tables, constants)
            if not is_compiled:
                return run_eagerly(body, loop, tables, constants, num_steps, shape, request.record)
            return run_compiled(body, loop, tables, constants, num_steps, shape)

        return with_fallback(mode, is_compiled, run)
