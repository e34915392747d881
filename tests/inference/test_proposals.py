"""Truncated proposals, against a posterior whose highest-density region is an interval."""

import pytest
import torch

from npdr_ppl.inference.base import Density, Problem
from npdr_ppl.inference.parts.bases.truncated import sample_truncated_prior
from npdr_ppl.randomness import seeded

OUTSIDE = 0.05


class Gaussian(Density):
    def __init__(self, mean, sd):
        self.law = torch.distributions.Normal(mean, sd)

    def sample(self, num_samples):
        return self.law.sample((num_samples, 1))

    def log_prob(self, z):
        return self.law.log_prob(z)[:, 0]


@pytest.mark.parametrize("sd", [0.4, 0.001], ids=["rejection", "resampling"])
def test_draws_are_the_prior_restricted_to_the_region(sd):
    n, prior = 2000, torch.distributions.Normal(0.0, 1.0)
    problem = Problem(
        1, torch.zeros(1), lambda n: torch.randn(n, 1), lambda z: prior.log_prob(z)[:, 0]
    )
    with seeded(0):
        z = sample_truncated_prior(problem, n, Gaussian(0.7, sd), OUTSIDE)
    assert z.shape == (n, 1)
    half = sd * prior.icdf(torch.tensor(1 - OUTSIDE / 2)).item()
    # The bound is a quantile of 10 000 draws: its relative error is about 1 %.
    assert ((z - 0.7).abs() < 1.05 * half).all()
    edges = torch.tensor([0.7 - half, 0.7 + half], dtype=torch.float64)
    low, high = torch.special.ndtr(edges)
    uniform = (torch.special.ndtr(z[:, 0].double().sort().values) - low) / (high - low)
    distance = (uniform - torch.arange(1, n + 1) / n).abs().max()
    # 1.95 / sqrt(n) is the Kolmogorov-Smirnov bound at a false-alarm rate of 0.1 %.
    assert distance < 1.95 / n**0.5 + 0.02


def test_the_region_holds_the_posterior():
    prior = torch.distributions.Normal(0.0, 1.0)
    problem = Problem(
        1, torch.zeros(1), lambda n: torch.randn(n, 1), lambda z: prior.log_prob(z)[:, 0]
    )
    posterior = Gaussian(-0.5, 0.3)
    with seeded(1):
        z = sample_truncated_prior(problem, 5000, posterior, OUTSIDE)
        draws = posterior.sample(5000)
    inside = ((draws > z.min()) & (draws < z.max())).float().mean()
    assert abs(inside - (1 - OUTSIDE)) < 4 * (OUTSIDE * (1 - OUTSIDE) / 5000) ** 0.5 + 0.01
