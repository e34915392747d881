"""Flow matching beyond the contract: its loss, its density, what it can represent, options."""

import math

import pytest
import torch

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.fmpe import FMPE, flow_matching_loss
from npdr_ppl.inference.parts.flows.velocity import VelocityDensity, VelocityNetwork, end_angle
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.training.preconditioning import fit_preconditioner
from npdr_ppl.randomness import seeded

NORMAL = torch.distributions.Normal(0.0, 1.0)
SIGMA = 0.01


def make_problem(d, observation, build_network=None):
    return Problem(
        num_parameters=d,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: NORMAL.log_prob(z).sum(-1),
        build_network=build_network,
    )


def untrained(d, num_features=2, scale=0.5):
    with seeded(0, "network"):
        network = VelocityNetwork(d, num_features, None, 16, 8)
        torch.nn.init.normal_(network.last.weight, std=scale)
    return network.requires_grad_(False)


@pytest.mark.parametrize("d", [1, 3])
def test_divergence_is_the_trace_of_the_jacobian(d):
    network = untrained(d).double()
    with seeded(1):
        y = torch.randn(4, d, dtype=torch.float64)
        angle, f = torch.rand(4, dtype=torch.float64), torch.randn(4, 2, dtype=torch.float64)
    modulation = network.modulate(angle, network.embed(f))
    value, divergence = network.velocity_and_divergence(y, modulation)
    torch.testing.assert_close(value, network.velocity(y, modulation))
    for n in range(4):
        jacobian = torch.autograd.functional.jacobian(
            lambda row, m=modulation[n]: network.velocity(row, m), y[n]
        )
        torch.testing.assert_close(divergence[n], jacobian.trace())


def test_loss_is_that_of_the_optimal_transport_path():
    # Written with the paper's u_t and its velocity for a time t, and the factors by hand.
    with seeded(2):
        u, noise, t = torch.randn(1, 5, 2), torch.randn(1, 5, 1, 2), torch.rand(1, 5, 1)
    a, b = 1 - (1 - SIGMA) * t, t
    r = (a**2 + b**2).sqrt()[..., None]
    u_t = a[..., None] * noise + b[..., None] * u[..., None, :]
    target = u[..., None, :] - (1 - SIGMA) * noise
    # d/dt of u_t = r y: dr/dt y + r dphi/dt v, with dphi/dt = 1 / r^2 (a d/dt b - b d/dt a).
    rate = (b - (1 - SIGMA) * a)[..., None] / r
    v = (target - rate * u_t / r) * r / (a + (1 - SIGMA) * b)[..., None]
    # A velocity that is the exact one has no loss; one that is off by 0.3 loses 2 * 0.09.
    angle = torch.atan2(b, a)
    exact = flow_matching_loss(lambda points, f: v, u, torch.zeros(1, 5, 1), noise, angle)
    off = flow_matching_loss(lambda points, f: v + 0.3, u, torch.zeros(1, 5, 1), noise, angle)
    torch.testing.assert_close(exact, torch.zeros(1, 5), atol=1e-10, rtol=0)
    torch.testing.assert_close(off, torch.full((1, 5), 0.18))
    assert end_angle(SIGMA) == pytest.approx(math.atan(1 / SIGMA))


def density(network, d, steps):
    with seeded(3):
        z, x = torch.randn(200, d), torch.randn(200, 2)
    return VelocityDensity(network, fit_preconditioner(z, x), torch.zeros(2), SIGMA, steps)


def test_density_integrates_to_one_on_a_grid():
    q = density(untrained(1, scale=1.0), 1, 20)
    grid = torch.linspace(-40, 40, 16_001)
    values = q.log_prob(grid[:, None]).exp()
    assert torch.trapezoid(values, grid) == pytest.approx(1.0, abs=1e-4)
    with seeded(4):
        z = q.sample(20_000)
    mean = torch.trapezoid(grid * values, grid)
    assert abs(z.mean() - mean) < 4.5 * z.std() / len(z) ** 0.5


def test_solver_converges_with_the_fourth_order():
    network = untrained(2, scale=1.0)
    with seeded(5):
        z = torch.randn(50, 2)
    exact = density(network, 2, 160).log_prob(z)
    errors = [(density(network, 2, k).log_prob(z) - exact).abs().mean() for k in (5, 10)]
    # Halving the step divides the error by 16 asymptotically.
    assert errors[1] < errors[0] / 8


@pytest.mark.slow
def test_learns_a_bimodal_posterior_in_rounds():
    # x = (z_1^2, z_2) + noise: the posterior given x_1 = 1 has modes at z_1 = -1 and 1.
    problem, method = make_problem(2, torch.tensor([1.0, 0.5])), FMPE()
    state = method.init(problem)
    for number in range(2):
        with seeded(5, number):
            z = method.ask(problem, state, 1500)
            x = torch.stack((z[:, 0] ** 2, z[:, 1]), -1) + 0.2 * torch.randn(1500, 2)
            state, _ = method.tell(problem, state, z, x)
    with seeded(6):
        z = Mixture(method.densities(problem, state)).sample(4000)
    # Exact: z_2 ~ N(0.5 / 1.04, 0.04 / 1.04); symmetric in z_1. Tolerances are training's.
    assert abs(z[:, 1].mean() - 0.5 / 1.04) < 0.1
    assert 0.3 < (z[:, 0] > 0).float().mean() < 0.7
    assert ((z[:, 0].abs() - 1).abs() < 0.4).float().mean() > 0.8


@pytest.mark.slow
def test_embedding_network_is_trained_with_the_velocity():
    time = torch.linspace(0, 1, 20)[:, None]
    problem = make_problem(
        1, 0.8 * time, lambda: torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(20, 4))
    )
    with seeded(2):
        z = torch.randn(1500, 1)
        x = z[:, :, None] * time + 0.05 * torch.randn(1500, 20, 1)
        method = FMPE()
        state, _ = method.tell(problem, method.init(problem), z, x)
        samples = Mixture(method.densities(problem, state)).sample(2000)
    assert abs(samples.mean() - 0.8) < 0.15
    assert samples.std() < 0.3


@pytest.mark.parametrize(
    "options", [{"hidden": 0}, {"context": 0}, {"draws": 0}, {"sigma": 0.0}, {"steps": 0}]
)
def test_options_are_checked(options):
    (name,) = options
    with pytest.raises(BackendError, match=name):
        FMPE(**options)
