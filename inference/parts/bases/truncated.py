"""Base class of backends that train in rounds on truncated proposals.

Deistler, Goncalves & Macke (2022), *Truncated proposals for scalable and hassle-free
simulation-based inference*, https://arxiv.org/abs/2210.04815. From the second round on, parameters
come from the prior restricted to a region. It holds all but a fraction epsilon of the current
posterior's mass. In this region the proposal is proportional to the prior. A conditional density
estimator is therefore trained as in the first round, without any correction.

Unlike the paper, we train only on the simulations near that region, those of earlier rounds
included. The other simulations have no information on the posterior. Without them, an estimator
and a regression need to describe only a small neighbourhood, in which the simulator is nearly
linear.
"""

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density, Problem, State
from npdr_ppl.inference.parts.bases.neural_backend import NeuralBackend, NeuralState
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture

__all__ = ["TruncatedBackend", "log_density_bound", "sample_truncated_prior"]

logger = logging.getLogger(__name__)

NUM_BOUND_SAMPLES = 10_000
"""Number of posterior samples from which the region's bound is computed."""

CHUNK = 16_384
"""Number of prior draws tested in one batch."""

MIN_ACCEPTANCE = 5e-3
"""If a smaller share of prior draws is accepted, importance resampling replaces rejection."""

OVERSAMPLING = 32
"""Number of posterior draws per resampled draw. Deistler et al. (2022, Appendix 6.4) use 1024 and
draw one of each group; resampling one weighted set without replacement needs fewer."""

OUTSIDE_EARLIER = 1e-3
"""Mass of an earlier posterior outside the region for which it is a proposal. It is less than
within one inference, because other data may move the posterior."""


@dataclass(frozen=True)
class TruncatedBackend(NeuralBackend):
    """A backend whose later rounds draw from the prior near the current posterior.

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
            # The neighbourhood covers all of the posterior's draws. Its margin around the region
            # of the proposals gives the estimator data beyond that region's edge.
            bound = log_density_bound(posterior, 0.0)
            return posterior.log_prob(state.simulations.z) > bound


def sample_truncated_prior(
    problem: Problem, num_samples: int, posterior: Density, outside: float
) -> Tensor:
    """Draws from p(z) restricted to a region {z: log q(z | x_o) > tau} (their Eq. 2).

    The bound tau leaves a fraction epsilon of the posterior's mass outside. Prior draws are
    rejected outside the region. If the region is too small a part of the prior, draws of q inside
    it are resampled with weights p / q (their §3.2 and Appendix 6.4).

    Args:
        problem: Gives the prior.
        num_samples: Number of draws n.
        posterior: The current posterior q.
        outside: Fraction epsilon.

    Returns:
        Draws ``(num_samples, d)``.
    """
    tau = log_density_bound(posterior, outside)
    accepted: list[Tensor] = []
    found, tried = 0, 0
    while found < num_samples:
        z = problem.sample_prior(CHUNK)
        z = z[posterior.log_prob(z) > tau]
        accepted.append(z)
        found, tried = found + len(z), tried + CHUNK
        if found < num_samples and found < MIN_ACCEPTANCE * tried:
            logger.info("Resampling: %d of %d prior draws lie in the region.", found, tried)
            return _resample(problem, num_samples, posterior, tau)
    return torch.cat(accepted)[:num_samples]


def log_density_bound(posterior: Density, outside: float) -> Tensor:
    """Returns tau such that a fraction ``outside`` of q's mass has log q below it."""
    return posterior.log_prob(posterior.sample(NUM_BOUND_SAMPLES)).quantile(outside)


def _resample(problem: Problem, num_samples: int, posterior: Density, tau: Tensor) -> Tensor:
    """Draws by sampling importance resampling with the posterior as the proposal."""
    z = posterior.sample(OVERSAMPLING * num_samples)
    log_q = posterior.log_prob(z)
    log_weight = (problem.log_prior(z) - log_q).masked_fill(log_q <= tau, -torch.inf)
    # Gumbel top-k: sampling without replacement in proportion to the weights.
    gumbel = -torch.empty_like(log_weight).exponential_().log()
    return z[(log_weight + gumbel).topk(num_samples).indices]
