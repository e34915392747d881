"""BayesSim beyond the contract: Fourier features, further rounds, going on."""

import math

import pytest
import torch
from torch import nn

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.bayessim import BayesSim
from npdr_ppl.inference.online_bayessim import OnlineBayesSim
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.samplers.fourier import FourierFeatures, median_distance
from npdr_ppl.randomness import seeded

NORMAL = torch.distributions.Normal(0.0, 1.0)


def make_problem(d, observation, is_normal=True, build_network=None):
    return Problem(
        num_parameters=d,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: NORMAL.log_prob(z).sum(-1),
        is_prior_standard_normal=is_normal,
        build_network=build_network,
    )


def tell(method, problem, state, simulate, n, seed):
    with seeded(seed):
        z = method.ask(problem, state, n)
        return method.tell(problem, state, z, simulate(z))


KERNEL_FUNCTIONS = {
    "rbf": lambda r: (-(r**2) / 2).exp(),
    "matern-3/2": lambda r: (1 + 3**0.5 * r) * (-(3**0.5) * r).exp(),
    "matern-5/2": lambda r: (1 + 5**0.5 * r + 5 * r**2 / 3) * (-(5**0.5) * r).exp(),
}


@pytest.mark.parametrize("kernel", KERNEL_FUNCTIONS)
def test_fourier_features_approximate_the_kernel(kernel):
    m = 4096
    with seeded(0):
        features = FourierFeatures(3, m, kernel)
        f, other = torch.randn(2, 40, 3)
    approximate = features(f) @ features(other).T
    exact = KERNEL_FUNCTIONS[kernel](torch.cdist(f, other))
    # Plain random frequencies would err by (2 m)^-1/2 or 0.011, 4.5 times that at worst.
    assert (approximate - exact).abs().max() < 0.05


def test_median_distance():
    with seeded(1):
        f = torch.randn(5000, 2)
        # |f - f'|^2 / 2 is chi-squared with two degrees of freedom, of median 2 log 2.
        assert median_distance(f) == pytest.approx((4 * math.log(2)) ** 0.5, rel=0.05)
        assert median_distance(torch.zeros(10, 2)) == 1.0


@pytest.mark.parametrize("features", ["neural", "fourier"])
def test_learns_both_modes(features):
    problem = make_problem(1, torch.tensor([1.0]))
    method = BayesSim(features=features, components=3, members=1, epochs=20)
    state, info = tell(
        method,
        problem,
        method.init(problem),
        lambda z: z**2 + 0.2 * torch.randn_like(z),
        2000,
        2,
    )
    with seeded(3):
        z = Mixture(method.densities(problem, state)).sample(4000)
    assert 0.3 < (z > 0).float().mean() < 0.7
    assert ((z.abs() - 1).abs() < 0.4).float().mean() > 0.85
    assert info.losses["best_epoch"][0] > 0


@pytest.mark.parametrize("features", ["neural", "fourier"])
def test_one_round_does_with_any_prior_and_a_second_one_says_why_not(features):
    problem = make_problem(1, torch.zeros(1), is_normal=False)
    method = BayesSim(features=features, epochs=2)
    state, _ = tell(method, problem, method.init(problem), lambda z: z**3, 50, 4)
    with pytest.raises(BackendError, match="use one round, or snpe-c"):
        method.ask(problem, state, 10)


def test_fourier_features_need_a_final_embedding():
    problem = make_problem(1, torch.zeros(4), build_network=lambda: nn.Linear(4, 2))
    with pytest.raises(BackendError, match="embedding that is not trained"):
        BayesSim(features="fourier").init(problem)


@pytest.mark.parametrize("features", ["neural", "fourier"])
def test_online_goes_on_from_its_networks(features):
    problem = make_problem(1, torch.tensor([1.0]))
    method = OnlineBayesSim(features=features, components=3, members=1, epochs=20)

    def simulate(z):
        return z**2 + 0.2 * torch.randn_like(z)

    first, _ = tell(method, problem, method.init(problem), simulate, 2000, 5)
    # With a step too small to matter the second round can only repeat the first's posterior.
    still = OnlineBayesSim(
        features=features, components=3, members=1, epochs=1, learning_rate=1e-12
    )
    second, _ = tell(still, problem, first, simulate, 100, 6)
    points = torch.linspace(-2, 2, 9)[:, None]
    (before,), (after,) = method.densities(problem, first), still.densities(problem, second)
    torch.testing.assert_close(before.log_prob(points), after.log_prob(points))
    assert OnlineBayesSim.continues and not BayesSim.continues


@pytest.mark.parametrize(
    "options", [{"features": "wavelets"}, {"kernel": "linear"}, {"frequencies": 0}]
)
def test_options_are_checked(options):
    (name,) = options
    with pytest.raises(BackendError, match=name):
        BayesSim(**options)
