"""Mixtures of Gaussians, against torch's own and moments."""

import torch
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture, triangular_factors
from npdr_ppl.randomness import seeded


def make(components=3, d=2, seed=0):
    with seeded(seed):
        roots = torch.randn(components, d, d, dtype=torch.float64)
        covariances = roots @ roots.mT + 0.1 * torch.eye(d, dtype=torch.float64)
        means = torch.randn(components, d, dtype=torch.float64)
        weights = torch.rand(components, dtype=torch.float64) + 0.2
        return weights / weights.sum(), means, covariances


def test_log_prob_is_torchs():
    weights, means, covariances = make()
    expected = MixtureSameFamily(Categorical(weights), MultivariateNormal(means, covariances))
    with seeded(1):
        z = 3 * torch.randn(50, 2, dtype=torch.float64)
    mixture = GaussianMixture.from_moments(weights, means, covariances)
    torch.testing.assert_close(mixture.log_prob(z), expected.log_prob(z))
    torch.testing.assert_close(mixture.weights, weights)
    torch.testing.assert_close(mixture.covariances, covariances)


def test_draws_have_the_stated_moments():
    mixture = GaussianMixture.from_moments(*make(seed=2))
    mean, covariance = mixture.moments()
    n = 40_000
    with seeded(3):
        z = mixture.sample(n).double()
    sd = covariance.diagonal().sqrt()
    assert ((z.mean(0) - mean).abs() < 4.5 * sd / n**0.5).all()
    away = z - mean
    products = away[:, :, None] * away[:, None]
    error = products.std(0) / n**0.5
    assert ((products.mean(0) - covariance).abs() < 4.5 * error).all()


def test_very_narrow_oblique_components_keep_their_meaning():
    # Standard deviations of 1 and 1e-9 along the diagonals: their covariance matrix is singular
    # in float64.
    turn = torch.tensor([[1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64) / 2**0.5
    factor = triangular_factors(torch.diag(torch.tensor([1.0, 1e9]).double()) @ turn)
    mixture = GaussianMixture(torch.zeros(1), torch.zeros(1, 2), factor[None])
    along = torch.tensor([[1.0, 1.0]], dtype=torch.float64) / 2**0.5
    values = mixture.log_prob(torch.cat((0 * along, along)))
    torch.testing.assert_close(values[0] - values[1], torch.tensor(0.5).double())
    with seeded(4):
        z = mixture.sample(1000)
    assert z.isfinite().all() and abs((z @ along[0].float()).std() - 1) < 0.1
