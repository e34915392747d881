"""Base class of backends that learn a likelihood, or a likelihood ratio, instead of a posterior.

They estimate log L(z; x) = log p(x | z) + c(x) with any c. The posterior at an observation is p(z)
L(z; x_o) / Z, sampled by tempering (:mod:`npdr_ppl.inference.parts.samplers.tempering`). The
proposal of the parameters does not matter, so sequential rounds need no correction. A learned
likelihood can be used with any other prior, hierarchical ones included.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Density, Problem, State
from npdr_ppl.inference.parts.bases.neural_backend import NeuralBackend, NeuralState
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.samplers.tempering import UnnormalisedDensity

__all__ = ["LearnedLogLikelihood", "LikelihoodBackend"]

LearnedLogLikelihood = Callable[[Tensor, Tensor], Tensor]
"""Maps parameters ``(n, d)`` and features ``(n, F)`` to log L, ``(n,)``; differentiable."""


@dataclass(frozen=True)
class LikelihoodBackend(NeuralBackend):
    """A backend that learns log L(z; x); options are those of the parent class."""

    amortises: ClassVar[bool] = True

    def init(self, problem: Problem) -> NeuralState:
        """Returns the state before any simulation.

        Raises:
            BackendError: The features come from a network that is trained jointly.
        """
        if problem.build_network is not None:
            raise BackendError(
                f"{self.name} learns the density of features, so they must be fixed; choose an "
                "embedding that is not trained, e.g. 'bayessim' or 'all/50'."
            )
        return super().init(problem)

    @abstractmethod
    def log_likelihoods(self, problem: Problem, state: State) -> list[LearnedLogLikelihood]:
        """Returns the learned log L of every ensemble member.

        Raises:
            BackendError: Nothing has been learnt yet.
        """

    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes draws of the prior, later of the posterior, ``(num_simulations, d)``."""
        if state.round == 0:
            return problem.sample_prior(num_simulations)
        return Mixture(self.densities(problem, state)).sample(num_simulations)

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the posterior of every ensemble member."""
        observation = problem.observation.to("cpu", torch.float32)

        def at_observation(log_likelihood: LearnedLogLikelihood) -> Callable[[Tensor], Tensor]:
            return lambda z: log_likelihood(z, observation.expand(len(z), -1))

        return [
            UnnormalisedDensity(problem, at_observation(member))
            for member in self.log_likelihoods(problem, state)
        ]
