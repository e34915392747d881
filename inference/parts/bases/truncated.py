"""What backends share that train in rounds on truncated proposals.

Deistler, Goncalves & Macke (2022), *Truncated proposals for scalable and hassle-free
simulation-based inference*, https://arxiv.org/abs/2210.04815: from the second round on, parameters
come from the prior restricted to the region that holds all but a fraction epsilon of the present
posterior's mass. Wherever the posterior has mass the proposal is proportional to the prior, so
that a conditional density estimator is trained as in the first round, without any correction.

We depart from the paper in training on the simulations near that region only, those of earlier
rounds included: the rest says nothing about the posterior, and without it an estimator and a
regression need to describe a small neighbourhood only, in which the simulator is nearly linear.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density, Problem, State
from npdr_ppl.inference.parts.bases.neural_backend import NeuralBackend, NeuralState
from npdr_ppl.inference.parts.bases.proposals import log_density_bound, sample_truncated_prior
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture

__all__ = ["TruncatedBackend"]

OUTSIDE_EARLIER = 1e-3
"""Mass of an earlier posterior outside the region it is a proposal for: less than within one
inference, because other data may move the posterior."""


@dataclass(frozen=True)
class TruncatedBackend(NeuralBackend):
    """A backend whose later rounds simulate the prior near the present posterior.

    Args:
        outside: Posterior mass epsilon outside the region of truncated proposals.

    The other options are those of
    :class:`~npdr_ppl.inference.parts.bases.neural_backend.NeuralBackend`.
    """

    outside: float = 1e-2

    def __post_init__(self) -> None:
        """Validates the options."""
        super().__post_init__()
        self._check_ranges(outside=(0.0, 0.5))

    def ask(self, problem: Problem, state: State, num_simulations: int) -> Tensor:
        """Proposes parameters to simulate, ``(num_simulations, d)``."""
        if state.round == 0:
            return problem.sample_prior(num_simulations)
        posterior = Mixture(self.densities(problem, state))
        with torch.no_grad():
            return sample_truncated_prior(problem, num_simulations, posterior, self.outside)

    def ask_near(
        self, problem: Problem, posterior: Density, num_simulations: int
    ) -> Tensor | None:
        """Proposes the prior restricted to the region of an earlier posterior."""
        with torch.no_grad():
            return sample_truncated_prior(problem, num_simulations, posterior, OUTSIDE_EARLIER)

    def _training_rows(self, problem: Problem, state: NeuralState) -> Tensor:
        """Returns which simulations lie in the neighbourhood to train on, ``(n,)``."""
        if state.round == 0:
            return super()._training_rows(problem, state)
        with torch.no_grad():
            posterior = Mixture(self.densities(problem, state))
            # As wide as the posterior's draws reach: the margin around the region of the
            # proposals shows an estimator what lies beyond that region's edge.
            bound = log_density_bound(posterior, 0.0)
            return posterior.log_prob(state.simulations.z) > bound
