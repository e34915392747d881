"""NUTS: the reference method for models whose recording has a differentiable density.

Hoffman & Gelman (2014), https://arxiv.org/abs/1111.4246, in Pyro's implementation, over the
reference coordinates z, where the prior is close to N(0, I). It needs no simulations from the
caller, because the density evaluates the simulator itself. Each chain is an ensemble member, so
that ArviZ's r-hat across members is that of the chains.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from pyro.infer import MCMC
from pyro.infer import NUTS as PyroNUTS
from torch import Tensor

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend, Density, Problem, Progress, State
from npdr_ppl.inference.parts.samplers.tempering import (
    LogDensity,
    UnnormalisedDensity,
    tempered_particles,
)

__all__ = ["NUTS", "NUTSState"]

logger = logging.getLogger(__name__)

NUM_START_PARTICLES = 200
"""Number of particles tempered towards the posterior; chains start from these. Far from the
posterior, a step of NUTS would take the maximum number of evaluations."""


@dataclass(frozen=True)
class NUTSState(State):
    """The draws of NUTS.

    Attributes:
        draws: Draws of every chain, ``(chains, num_samples, d)``; empty before the first round.
    """

    draws: Tensor


@dataclass(frozen=True)
class NUTS(Backend[NUTSState]):
    """The No-U-Turn sampler; see the module's text.

    Args:
        chains: Number of chains, run one after another.
        num_samples: Number of draws kept per chain.
        warmup: Number of steps before these, in which step size and mass matrix adapt.
        max_tree_depth: Maximum number of doublings of a trajectory.
    """

    name: ClassVar[str] = "nuts"
    summary: ClassVar[str] = "Pyro's No-U-Turn sampler, the reference for differentiable models"
    uses_simulations: ClassVar[bool] = False
    state_class = NUTSState

    chains: int = 2
    num_samples: int = 1_000
    warmup: int = 300
    max_tree_depth: int = 6

    def __post_init__(self) -> None:
        """Validates the options."""
        self._check_at_least(1, "chains", "num_samples", "warmup", "max_tree_depth")

    def init(self, problem: Problem) -> NUTSState:
        """Returns the state before any draw.

        Raises:
            BackendError: The recording has no differentiable density under the model.
        """
        _density(problem)
        return NUTSState(0, torch.empty(0, 0, problem.num_parameters))

    def learn(
        self, problem: Problem, state: NUTSState, z: Tensor, x: Tensor, progress: Progress
    ) -> tuple[NUTSState, dict[str, Any]]:
        """Runs the chains anew; simulations are ignored. See :meth:`Backend.learn`."""
        log_likelihood = _density(problem)

        def potential(values: Mapping[str, Tensor]) -> Tensor:
            z = values["z"][None]
            return -(log_likelihood(z) + _differentiable_log_prior(problem, z))[0]

        particles = tempered_particles(problem, log_likelihood, NUM_START_PARTICLES).z
        total = self.chains * (self.warmup + self.num_samples)
        done, num_divergent, draws = 0, 0, []

        def report(*_: object) -> None:
            nonlocal done
            done += 1
            progress(done / total, f"chain {len(draws) + 1}, step {done} of {total}")

        for chain in range(self.chains):
            kernel = PyroNUTS(
                potential_fn=potential, full_mass=True, max_tree_depth=self.max_tree_depth
            )
            sampler = MCMC(
                kernel,
                num_samples=self.num_samples,
                warmup_steps=self.warmup,
                initial_params={"z": particles[chain].double()},
                hook_fn=report,
                disable_progbar=True,
            )
            sampler.run()
            draws.append(sampler.get_samples()["z"].float())
            num_divergent += len(sampler.diagnostics()["divergences"]["chain 0"])
        if num_divergent:
            logger.warning("nuts: %d of %d draws diverged.", num_divergent, total)
        return replace(state, draws=torch.stack(draws)), {"divergent": num_divergent}

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every chain."""
        draws = self._told(state).draws
        log_likelihood = _density(problem)
        return [UnnormalisedDensity(problem, log_likelihood, chain) for chain in draws]


def _density(problem: Problem) -> LogDensity:
    if problem.log_likelihood is None:
        raise BackendError(
            "nuts needs a model whose recording has a differentiable density: a differentiable, "
            "deterministic simulator with measurement noise, simulate(..., noise=...)."
        )
    return problem.log_likelihood


def _differentiable_log_prior(problem: Problem, z: Tensor) -> Tensor:
    if problem.is_prior_standard_normal:
        return -0.5 * z.square().sum(-1)
    return problem.log_prior(z)
