"""The base of a trained flow: its density, its draws and how it is fitted."""

import math

import pytest
import torch

from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.flows.flow_base import FlowBase, fit_base
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.training.preconditioning import fit_preconditioner, whiten_unseen
from npdr_ppl.inference.snpe_c import SNPEC
from npdr_ppl.randomness import seeded

NORMAL = torch.distributions.Normal(0.0, 1.0)


@pytest.mark.parametrize("base", [FlowBase(), FlowBase(1.3), FlowBase(0.8, 5.0)])
def test_density_is_normalised_and_that_of_the_draws(base):
    grid = torch.linspace(-60, 60, 400_001, dtype=torch.float64)
    density = base.log_prob(grid**2, 1).exp()
    assert torch.trapezoid(density, grid).item() == pytest.approx(1, abs=1e-3)
    with seeded(0):
        draws = base.sample(100_000, 1)[:, 0]
    for edge in (0.5, 1.5, 3.0):
        inside = grid.abs() < edge
        mass = torch.trapezoid(density[inside], grid[inside]).item()
        assert (draws.abs() < edge).double().mean().item() == pytest.approx(mass, abs=0.006)


def test_in_several_dimensions_it_is_the_multivariate_t():
    x = torch.tensor([[0.3, -1.0, 2.0], [4.0, 0.0, 1.0]], dtype=torch.float64)
    # A t distribution is a normal one whose variance is drawn anew for every point.
    with seeded(1):
        variance = 1.2**2 * 6.0 / torch.distributions.Chi2(6.0).sample((1_000_000,)).double()
    square = (x**2).sum(-1)
    for value, s in zip(FlowBase(1.2, 6.0).log_prob(square, 3), square, strict=True):
        density = ((-0.5 * s / variance).exp() / (2 * math.pi * variance) ** 1.5).mean()
        assert value.exp().item() == pytest.approx(density.item(), rel=0.03)


@pytest.mark.parametrize("truth", [FlowBase(), FlowBase(1.3), FlowBase(0.9, 4.0)])
def test_finds_the_base_that_rows_came_from(truth):
    with seeded(2):
        square = (truth.sample(5_000, 3) ** 2).sum(-1).expand(2, -1)
    found = fit_base(square, torch.zeros_like(square), 3)
    assert found.scale == pytest.approx(truth.scale, rel=0.06)
    assert 1 / found.freedom == pytest.approx(1 / truth.freedom, abs=0.06)


def test_few_rows_that_a_normal_base_explains_leave_it():
    with seeded(3):
        square = (torch.randn(60, 2) ** 2).sum(-1)[None]
    assert fit_base(square, torch.zeros_like(square), 2) == FlowBase()


def test_regression_with_many_features_is_as_wide_at_what_it_saw_as_at_what_it_did_not():
    with seeded(4):
        x, noise = torch.randn(1200, 100), torch.randn(1200, 2)
        z = x[:, :2] + 0.5 * noise
    preconditioner = fit_preconditioner(z[:200], x[:200])
    unseen, f = whiten_unseen(preconditioner, z[:200], x[:200])
    fresh = preconditioner.whiten(z[200:], preconditioner.features(x[200:]))
    seen = preconditioner.whiten(z[:200], f)
    assert unseen.std().item() == pytest.approx(fresh.std().item(), rel=0.1)
    assert seen.std() < 0.8 * fresh.std()


def make_problem():
    return Problem(
        num_parameters=2,
        observation=torch.zeros(2),
        sample_prior=lambda n: torch.randn(n, 2),
        log_prior=lambda z: NORMAL.log_prob(z).sum(-1),
    )


@pytest.mark.slow
def test_covers_what_few_simulations_leave_unknown():
    # Noise whose size depends on the parameters, which a regression does not see.
    def simulate(z):
        return z + (0.4 * z[:, :1]).exp() * 0.5 * torch.randn_like(z)

    problem, method = make_problem(), SNPEC()
    with seeded(5):
        z = torch.randn(1500, 2)
        state, _ = method.tell(problem, method.init(problem), z, simulate(z))
        truths = torch.randn(300, 2)
        ranks = []
        given = method.densities_given(problem, state, simulate(truths))
        for truth, members in zip(truths, given, strict=True):
            posterior = Mixture(members)
            log_q = posterior.log_prob(torch.cat((truth[None], posterior.sample(99))))
            ranks.append((log_q[1:] > log_q[0]).sum().item())
    # Binomial noise of 300 data sets is 0.023; the rest is the fit's.
    covered = sum(rank < 80 for rank in ranks) / len(ranks)
    assert abs(covered - 0.8) < 0.1


def test_base_is_written_with_the_weights_and_states_without_one_are_read():
    problem, method = make_problem(), SNPEC(epochs=2)
    with seeded(6):
        z = torch.randn(400, 2)
        x = z + torch.distributions.StudentT(2.0).sample(z.shape)
        state, _ = method.tell(problem, method.init(problem), z, x)
    tensors, values = method.tensors(state)
    assert tensors["weights.base.scale"].shape == (3,)
    points = torch.randn(20, 2)

    def log_prob(tensors):
        restored = method.restore(problem, tensors, values)
        return Mixture(method.densities(problem, restored)).log_prob(points)

    assert torch.equal(
        log_prob(tensors), Mixture(method.densities(problem, state)).log_prob(points)
    )
    older = {name: value for name, value in tensors.items() if ".base." not in name}
    plain = SNPEC(epochs=2, calibrates=False)
    with seeded(6):
        z = torch.randn(400, 2)
        x = z + torch.distributions.StudentT(2.0).sample(z.shape)
        unfitted, _ = plain.tell(problem, plain.init(problem), z, x)
    expected = Mixture(plain.densities(problem, unfitted)).log_prob(points)
    assert torch.equal(log_prob(older), expected)
