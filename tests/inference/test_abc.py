"""Rejection ABC beyond the contract: its kernels, the adjustment, rounds, options."""

import pytest
import torch

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.abc import ABC, KernelDensity
from npdr_ppl.inference.base import Problem
from npdr_ppl.randomness import seeded

NORMAL = torch.distributions.Normal(0.0, 1.0)


def make_problem(observation, build_network=None):
    return Problem(
        num_parameters=1,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, 1),
        log_prior=lambda z: NORMAL.log_prob(z).sum(-1),
        build_network=build_network,
    )


def fit(method, problem, rounds=1, n=5000, noise=0.5):
    state = method.init(problem)
    for number in range(rounds):
        with seeded(number):
            z = method.ask(problem, state, n)
            state, info = method.tell(problem, state, z, z + noise * torch.randn(n, 1))
    return method.densities(problem, state)[0], info


def test_kernels_keep_mean_and_covariance():
    with seeded(0):
        points = (
            torch.randn(50, 2, dtype=torch.float64)
            @ torch.tensor([[2.0, 1.0], [0.0, 0.3]]).double()
        )
        weight = torch.rand(50, dtype=torch.float64)
        z = KernelDensity(points, weight).sample(200_000).double()
    share = (weight / weight.sum())[:, None]
    mean = (share * points).sum(0)
    covariance = (points - mean).T @ (share * (points - mean))
    sd = covariance.diagonal().sqrt()
    assert ((z.mean(0) - mean).abs() < 4.5 * sd / len(z) ** 0.5).all()
    limit = 4.5 * (2 / len(z)) ** 0.5 * torch.outer(sd, sd)
    assert ((z.T.cov() - covariance).abs() < 1.5 * limit).all()  # 1.5: heavier than Gaussian tails


def test_density_is_the_mixture_written_as_a_sum():
    points = torch.tensor([[0.0], [1.0], [4.0]], dtype=torch.float64)
    weight = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    mean, effective = 1.7, 1 / (0.04 + 0.25 + 0.09)
    variance = 0.2 * 1.7**2 + 0.5 * 0.7**2 + 0.3 * 2.3**2
    h = (4 / (3 * effective)) ** 0.2
    c = (1 - h**2) ** 0.5
    grid = torch.linspace(-3, 7, 9, dtype=torch.float64)
    expected = sum(
        w
        * torch.distributions.Normal(mean + c * (p - mean), h * variance**0.5).log_prob(grid).exp()
        for w, p in zip(weight.tolist(), points[:, 0].tolist(), strict=True)
    )
    actual = KernelDensity(points, weight).log_prob(grid[:, None]).exp()
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-9)


def test_regression_adjustment_removes_the_width_of_the_acceptance():
    # z ~ N(0, 1), x = z + noise of variance 1/4: the posterior has variance 1/5. Accepting half
    # of all simulations leaves a wider sample, which the regression narrows to the posterior.
    problem = make_problem(torch.tensor([0.5]))
    raw, _ = fit(ABC(accept=0.5, is_adjusted=False), problem)
    adjusted, _ = fit(ABC(accept=0.5), problem)
    with seeded(9):
        wide, right = raw.sample(20_000).var(), adjusted.sample(20_000).var()
    error = (2 / 2000) ** 0.5  # relative, of a variance from about 2000 effective simulations
    assert wide > 0.2 * (1 + 5 * error)
    assert abs(right - 0.2) < 4.5 * 0.2 * error


def test_rounds_add_simulations():
    problem, method = make_problem(torch.tensor([0.5])), ABC(accept=0.02, min_accepted=2)
    _, first = fit(method, problem)
    _, second = fit(method, problem, rounds=2)
    assert first.losses["accepted"] == 100 and second.losses["accepted"] == 200
    _, nearest = fit(ABC(accept=0.01, min_accepted=2), problem, rounds=2)
    assert nearest.losses["accepted"] == 100
    assert nearest.losses["largest_distance"] < first.losses["largest_distance"]


def test_all_simulations_equally_far_give_the_prior():
    problem, method = make_problem(torch.tensor([1.0])), ABC()
    with seeded(0):
        z = torch.randn(2000, 1)
        state, _ = method.tell(problem, method.init(problem), z, torch.ones(2000, 1))
        samples = method.densities(problem, state)[0].sample(5000)
    assert abs(samples.mean()) < 0.15 and abs(samples.std() - 1) < 0.15


def test_trains_no_network():
    with pytest.raises(BackendError, match="no network"):
        ABC().init(make_problem(torch.zeros(3, 2), torch.nn.Flatten))


@pytest.mark.parametrize("options", [{"accept": 0.0}, {"accept": 1.5}, {"min_accepted": 1}])
def test_options_are_checked(options):
    (name,) = options
    with pytest.raises(BackendError, match=name):
        ABC(**options)
