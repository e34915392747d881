"""A polynomial fitted to draws stands for a log density where the draws are."""

import torch

from npdr_ppl.preparation.density_surrogate import DensitySurrogate
from npdr_ppl.preparation.polynomials import fit_polynomial, num_terms


def bent(w):
    return -0.5 * (w[:, 0].square() + 4.0 * (w[:, 1] - 0.3 * w[:, 0].square()).square())


def weighted_draws(number, seed=0):
    generator = torch.Generator().manual_seed(seed)
    w = 1.5 * torch.randn(number, 2, generator=generator, dtype=torch.float64)
    log_weights = bent(w) + 0.5 * (w / 1.5).square().sum(-1)
    return w, log_weights.log_softmax(0), bent(w)


def test_a_surrogate_is_close_to_the_log_density_and_zero_far_away():
    surrogate = DensitySurrogate.of(*weighted_draws(600))
    w, log_weights, exact = weighted_draws(300, seed=1)
    near = exact > -8.0
    difference = surrogate(w[near]) - exact[near]
    assert difference.std() < 1e-6  # the density is itself a polynomial of degree 4
    assert surrogate(torch.tensor([[50.0, 0.0]]).double()) == -torch.inf


def test_failed_simulations_do_not_count():
    w, log_weights, exact = weighted_draws(600)
    exact[:50], log_weights[:50] = -torch.inf, -torch.inf
    surrogate = DensitySurrogate.of(w, log_weights.log_softmax(0), exact)
    assert (surrogate(w[50:]) - exact[50:])[exact[50:] > -8.0].std() < 1e-6


def test_there_is_no_surrogate_of_too_few_draws():
    assert DensitySurrogate.of(*weighted_draws(8)) is None
    w, log_weights, exact = weighted_draws(20)
    assert DensitySurrogate.of(w, log_weights, torch.full_like(exact, -torch.inf)) is None


def test_the_degree_is_that_of_the_function_below_noise():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(400, 3, generator=generator, dtype=torch.float64)
    values = (1.0 + points[:, 0] * points[:, 1])[:, None]
    noise = 0.1 * torch.randn(values.shape, generator=generator, dtype=torch.float64)
    found = fit_polynomial(
        points,
        values + noise,
        weights=torch.ones(400, dtype=torch.float64),
        importance=torch.ones(1, dtype=torch.float64),
        most_degree=4,
        points_per_coefficient=3,
    )
    assert found.degree == 2
    assert num_terms(3, 2) == len(found.coefficients) == 10
    assert (found(points) - values).abs().max() < 0.1
