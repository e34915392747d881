"""Truncated proposals: the prior restricted to the region of the current posterior's mass.

Deistler, Goncalves & Macke (2022), *Truncated proposals for scalable and hassle-free
simulation-based inference*, https://arxiv.org/abs/2210.04815.
"""

import logging

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density, Problem

__all__ = ["log_density_bound", "sample_truncated_prior"]

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
