"""Learned likelihoods and ratios beyond the contract."""

import math

import pytest
import torch
from torch import nn

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.nle import NLE
from npdr_ppl.inference.nre import contrastive_loss
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.training.likelihood_preconditioning import (
    degrees_of,
    discriminants,
    fit_likelihood_preconditioner,
    polynomials,
)
from npdr_ppl.inference.registry import backend
from npdr_ppl.randomness import seeded

NORMAL = torch.distributions.Normal(0.0, 1.0)


def make_problem(d, observation, build_network=None):
    return Problem(
        num_parameters=d,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: NORMAL.log_prob(z).sum(-1),
        build_network=build_network,
    )


def test_contrastive_loss_equals_its_definition_written_as_loops():
    with seeded(0):
        num_rows, d, num_atoms, gamma = 7, 2, 2, 1.7
        z, f, gain = torch.randn(num_rows, d), torch.randn(num_rows, 2), torch.randn(d, 2)
        factor = torch.tensor([[0.7, 0.0], [0.2, 1.3]])
    rows = torch.tensor([[3, 0, 6, 1, 2], [1, 5, 4, 0, 3]])

    def whiten(z, f):
        return torch.linalg.solve(factor, z - gain @ f)

    def log_ratio(v, u):
        return 0.3 * v[..., 0] - u.square().sum(-1)

    def correction(v, f):
        return v[..., None, :, 1] * f[..., :, None, 1]

    u = torch.stack([whiten(z[n], f[n]) for n in range(num_rows)])
    spread = torch.linalg.solve(factor, z.T).T
    loss = contrastive_loss(z, u, spread, f, log_ratio, num_atoms, gamma, correction, rows)

    def h(m, n):  # parameters of row m, features of row n
        return (log_ratio(z[m], whiten(z[m], f[n])) + z[m, 1] * f[n, 1]).item()

    g = gamma / num_atoms
    for member, numbers in enumerate(rows.tolist()):
        groups = [numbers[:3]] * 3 + [numbers[-3:]] * 2  # the last two rows join one before
        for k, (n, group) in enumerate(zip(numbers, groups, strict=True)):
            others = [m for m in group if m != n]
            following = group[(group.index(n) + 1) % len(group)]
            marginal = sum(math.exp(h(m, n)) for m in others)
            joint = sum(math.exp(h(m, n)) for m in group if m != following)
            independent = -math.log(1 / (1 + g * marginal))
            right = -math.log(g * math.exp(h(n, n)) / (1 + g * joint))
            expected = (independent + gamma * right) / (1 + gamma)
            assert loss[member, k].item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_contrastive_loss_is_least_at_the_ratio_whatever_the_proposal():
    # z ~ N(1, 0.5^2) and x = z + e: h must be log N(x; z, 1) - log N(x; 1, 1.25).
    with seeded(1):
        n = 15_000
        z = 1 + 0.5 * torch.randn(n, 1)
        x = z + torch.randn(n, 1)

    def mean_loss(slope, offset):
        def correction(v, f):
            likelihood = torch.distributions.Normal(v[..., None, :, 0], 1.0)
            marginal = torch.distributions.Normal(torch.tensor(1.0), 1.25**0.5)
            features = f[..., :, None, 0]
            exact = likelihood.log_prob(features) - marginal.log_prob(features)
            return (1 + slope) * exact + offset

        zero = torch.zeros(n, 1)
        rows = torch.arange(n)[None]
        return contrastive_loss(
            z, zero, zero, x, lambda v, u: 0 * (v + u)[..., 0], 8, 1.0, correction, rows
        )[0]

    best = mean_loss(0.0, 0.0)
    for change in ((0.3, 0.0), (-0.3, 0.0), (0.0, 0.4), (0.0, -0.4)):
        difference = mean_loss(*change) - best
        error = difference.std() / n**0.5
        assert difference.mean() > 4.5 * error


def test_polynomials_are_products_of_chebyshev_polynomials():
    degrees = degrees_of(2, 3)
    assert len(degrees) == math.comb(5, 3) - 1
    f = torch.tensor([[0.3, -0.8], [5.0, 0.1]])  # the second lies outside and is moved to 1
    edges = torch.tensor([[-1.0, -1.0], [1.0, 1.0]])
    found = polynomials(f, edges, degrees)
    inside = f.clamp(-1, 1).arccos()
    for term, (a, b) in enumerate(degrees.tolist()):
        exact = (a * inside[:, 0]).cos() * (b * inside[:, 1]).cos()
        torch.testing.assert_close(found[:, term], exact, rtol=1e-4, atol=1e-5)


def test_discriminants_of_a_linear_gaussian_problem_are_sufficient():
    # With x = A z + S e all that x says about z is A^T S^-2 x: the same space must come out.
    with seeded(2):
        n, num_features = 20_000, 30
        a, s = torch.randn(num_features, 2), 0.5 + torch.rand(num_features)
        z = torch.randn(n, 2)
        x = z @ a.T + s * torch.randn(n, num_features)
    found = discriminants(x, z, 2)
    exact = a / s[:, None] ** 2
    exact, found = ((s[:, None] * v).double() for v in (exact, found))  # unit noise
    q_exact, q_found = torch.linalg.qr(exact)[0], torch.linalg.qr(found)[0]
    cosines = torch.linalg.svdvals(q_exact.T @ q_found)
    # Each of 30 coefficients is known to 1 / sqrt(n) of the noise, the signal is its |A / S|.
    assert (1 - cosines.square()).max() < 4.5**2 * num_features / n


def test_a_smooth_mean_is_regressed_away_and_the_posterior_recovered():
    # Forty readings sin(0.4 z) a_j + e_j; the exact posterior is known on a grid.
    with seeded(3):
        amplitudes = torch.randn(40)
        z = torch.randn(4000, 1)
        x = torch.sin(0.4 * z) * amplitudes + 0.5 * torch.randn(4000, 40)
        observation = math.sin(0.4 * 0.6) * amplitudes + 0.5 * torch.randn(40)
    fitted = fit_likelihood_preconditioner(z, x, 4)
    assert fitted.degrees.max() >= 2
    grid = torch.linspace(-4, 4, 8001)[:, None]
    mean = torch.sin(0.4 * grid) * amplitudes
    log_p = (-0.5 * ((observation - mean) / 0.5) ** 2).sum(-1) - 0.5 * grid[:, 0] ** 2
    p = log_p.softmax(0)
    exact_mean = (p * grid[:, 0]).sum()
    exact_sd = ((p * grid[:, 0] ** 2).sum() - exact_mean**2).sqrt()
    problem, method = make_problem(1, observation), NLE()
    with seeded(4):
        state, _ = method.tell(problem, method.init(problem), z, x)
        draws = Mixture(method.densities(problem, state)).sample(4000)[:, 0]
    assert abs(draws.mean() - exact_mean) < 0.3 * exact_sd
    assert 0.7 < draws.std() / exact_sd < 1.4


def distance_at_the_end_of_a_range(coordinates):
    """Total variation between learnt and exact posterior of a parameter at 99 % of its range."""
    amplitudes, noise = torch.linspace(0.5, 2.0, 8), 0.02
    with seeded(5):
        z = torch.randn(8000, 1)
        x = torch.special.ndtr(z) ** 2 * amplitudes + noise * torch.randn(8000, 8)
        observation = 0.99**2 * amplitudes + noise * torch.randn(8)
    problem, method = make_problem(1, observation), NLE(coordinates=coordinates)
    with seeded(6):
        state, _ = method.tell(problem, method.init(problem), z, x)
    grid = torch.linspace(1.6, 3.2, 60)[:, None]
    (log_likelihood,) = method.log_likelihoods(problem, state)
    with torch.no_grad():
        learnt = log_likelihood(grid, observation.expand(60, 8))
    errors = (observation - torch.special.ndtr(grid) ** 2 * amplitudes) / noise
    prior = -0.5 * grid[:, 0] ** 2
    p, q = ((t + prior).softmax(0) for t in (learnt, -0.5 * errors.square().sum(-1)))
    return float(0.5 * (p - q).abs().sum())


@pytest.mark.slow
def test_bounded_coordinates_learn_what_happens_at_the_end_of_a_range():
    bounded = distance_at_the_end_of_a_range("bounded")
    assert bounded < 0.1
    assert bounded < distance_at_the_end_of_a_range("normal")


def test_unknown_coordinates_are_refused():
    with pytest.raises(BackendError, match="coordinates"):
        NLE(coordinates="polar")


@pytest.mark.parametrize("name", ["nle", "nre"])
def test_refuses_an_embedding_that_is_learnt(name):
    problem = make_problem(1, torch.zeros(5), build_network=lambda: nn.Linear(5, 2))
    with pytest.raises(BackendError, match="must be fixed"):
        backend(name).init(problem)
