"""Tempered sequential Monte Carlo against closed forms."""

import math

import pytest
import torch

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.samplers.tempering import UnnormalisedDensity, tempered_particles
from npdr_ppl.randomness import seeded

NORMAL = torch.distributions.Normal(0.0, 1.0)

FALSE_ALARM = 4.5
"""Standard errors: of some twenty comparisons one fails by chance once in 7000 runs."""


def make_problem(d):
    return Problem(
        num_parameters=d,
        observation=torch.zeros(1),
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: NORMAL.log_prob(z).sum(-1),
    )


@pytest.mark.parametrize("noise", [1.0, 0.1, 1e-3])
def test_evidence_and_moments_of_a_gaussian(noise):
    # x = z + noise e: the evidence is N(x; 0, 1 + noise^2), the posterior N(x / (1 + noise^2), ..)
    x, n = torch.tensor([0.7, -1.2]), 4000

    def log_likelihood(z):
        return torch.distributions.Normal(z, noise).log_prob(x).sum(-1)

    with seeded(0):
        particles = tempered_particles(make_problem(2), log_likelihood, n)
    variance = 1 + noise**2
    exact = torch.distributions.Normal(0.0, variance**0.5).log_prob(x).sum().item()
    # A stage multiplies the evidence by a mean of n weights whose variation coefficient is at
    # most 1, because their effective share is at least a half.
    assert abs(particles.log_evidence - exact) < FALSE_ALARM * (particles.stages / n) ** 0.5
    sd = noise / variance**0.5
    assert ((particles.z.mean(0) - x / variance).abs() < FALSE_ALARM * 2 * sd / n**0.5).all()
    assert (particles.z.std(0) / sd - 1).abs().max() < FALSE_ALARM * 2 / (2 * n) ** 0.5


def test_modes_keep_their_weights():
    # Two narrow modes, of weights 3 and 1 after the prior, at which nothing can cross.
    centres = torch.tensor([-2.0, 2.0])
    weights = torch.tensor([0.75, 0.25])

    def log_likelihood(z):
        return torch.logsumexp(-0.5 * ((z - centres) / 0.05) ** 2 + weights.log(), -1)

    n = 4000
    with seeded(1):
        particles = tempered_particles(make_problem(1), log_likelihood, n)
    share = (particles.z[:, 0] < 0).double().mean().item()
    error = (0.75 * 0.25 * particles.stages / n) ** 0.5
    assert abs(share - 0.75) < FALSE_ALARM * error


def test_log_prob_is_normalised_and_given_draws_are_used():
    def log_likelihood(z):
        return -z.square().sum(-1)  # with the prior N(0, 1 / 3)

    problem = make_problem(2)
    exact = torch.distributions.Normal(0.0, 3**-0.5)
    z = torch.tensor([[0.0, 0.0], [0.5, -0.3]])
    density = UnnormalisedDensity(problem, log_likelihood)
    torch.testing.assert_close(density.log_prob(z), exact.log_prob(z).sum(-1), rtol=0.0, atol=0.05)
    draws = exact.sample((50, 2))
    with seeded(2):
        drawn = UnnormalisedDensity(problem, log_likelihood, draws).sample(70)
    assert len(drawn) == 70
    assert len(torch.unique(drawn, dim=0)) == 50  # all of them, some twice


def test_says_when_there_is_no_likelihood():
    with pytest.raises(BackendError, match="vanishes"):
        tempered_particles(make_problem(1), lambda z: z[:, 0] * math.nan, 100)
    with pytest.raises(BackendError, match="too peaked"):
        tempered_particles(make_problem(1), lambda z: -1e200 * z[:, 0].double().abs(), 100)
