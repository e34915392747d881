"""SNPE-C beyond the contract: the atomic loss, nonlinear posteriors, embeddings, options."""

import logging
import math

import pytest
import torch
from torch import nn

from npdr_ppl.errors import BackendError, ShapeError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend
from npdr_ppl.inference.snpe_c import SNPEC, atomic_loss
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


def test_atomic_loss_equals_its_definition_written_as_loops():
    with seeded(0):
        num_rows, d, num_atoms = 7, 2, 3
        z, x, gain = torch.randn(num_rows, d), torch.randn(num_rows, 2), torch.randn(d, 2)
        factor = torch.tensor([[0.7, 0.0], [0.2, 1.3]])
    log_prior = -z.abs().sum(-1)
    is_prior = torch.tensor([1, 0, 0, 1, 0, 1, 0], dtype=torch.bool)
    rows = torch.tensor([[3, 0, 6, 1, 2], [1, 5, 4, 0, 3]])

    def log_q(u, f):
        return -(u**2).sum(-1) - (u[..., 0] * f[..., 1]).exp()

    def whiten(z, f):
        return torch.linalg.solve(factor, z - gain @ f)

    def log_prob(u, f):
        return log_q(u, f[:, :, None].expand(-1, -1, u.shape[2], -1))

    u = torch.stack([whiten(z[n], x[n]) for n in range(num_rows)])
    spread = torch.linalg.solve(factor, z.T).T
    loss = atomic_loss(u, x, spread, log_prior, is_prior, num_atoms, log_prob, rows)

    for member, numbers in enumerate(rows.tolist()):
        for k, n in enumerate(numbers):
            atoms = [numbers[(k + step) % len(numbers)] for step in range(num_atoms)]
            ratios = [math.exp(log_q(whiten(z[m], x[n]), x[n]) - log_prior[m]) for m in atoms]
            expected = -math.log(ratios[0] / sum(ratios))
            if is_prior[n]:
                expected -= log_q(whiten(z[n], x[n]), x[n]).item()
            assert loss[member, k].item() == pytest.approx(expected, rel=1e-4)


def test_atomic_loss_is_least_at_the_posterior_whatever_the_proposal():
    # z ~ N(1, 0.5^2) instead of N(0, 1) and x = z + noise: the posterior N(x / 2, 1 / 2) of the
    # prior must minimise the loss; maximum likelihood would give that of the proposal.
    with seeded(1):
        n = 40_000
        z = 1 + 0.5 * torch.randn(n, 1)
        x = z + torch.randn(n, 1)
    nothing = torch.zeros(n, dtype=torch.bool)

    def mean_loss(shift, scale):
        q = torch.distributions.Normal(0.5 + shift, scale)  # slope of x fixed at the prior's

        def log_prob(u, f):
            return q.log_prob(u[..., 0] - 0.5 * f[:, :, None, 0] + 0.5)

        rows = torch.arange(n)[None]
        return atomic_loss(z, x, z, NORMAL.log_prob(z[:, 0]), nothing, 10, log_prob, rows)[0]

    best = mean_loss(0.0, 0.5**0.5)
    for shift, scale in [(0.15, 0.707), (-0.15, 0.707), (0.0, 0.6), (0.0, 0.85)]:
        difference = mean_loss(shift, scale) - best
        # Neighbouring rows share atoms; ten-row means are nearly independent.
        blocks = difference.view(-1, 10).mean(1)
        assert blocks.mean() > 3 * blocks.std() / len(blocks) ** 0.5


@pytest.mark.slow
@pytest.mark.parametrize("proposals", ["truncated", "atomic"])
@pytest.mark.parametrize("flow", ["nsf", "maf", "affine-nsf"])
def test_learns_a_bimodal_or_curved_posterior_in_rounds(flow, proposals):
    # x = (z_1^2, z_2) + noise: the posterior given x_1 = 1 has modes at z_1 = -1 and 1, which
    # affine maps cannot have but a spline can.
    problem = make_problem(2, torch.tensor([1.0, 0.5]))
    method = backend("snpe-c", flow=flow, proposals=proposals, num_atoms=5, epochs=20, members=1)
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
    if flow != "maf":
        assert ((z[:, 0].abs() - 1).abs() < 0.4).float().mean() > 0.85


def test_beats_its_linear_gaussian_start_where_the_posterior_is_not():
    problem = make_problem(1, torch.tensor([1.0]))
    with seeded(8):
        z = torch.randn(2000, 1)
        x = z**2 + 0.1 * torch.randn(2000, 1)
        _, info = SNPEC(epochs=15).tell(problem, SNPEC().init(problem), z, x)
    # log p(z | x) averages about 0.1; a Gaussian, which cannot follow |z|, reaches -1.42.
    assert min(info.losses["validation_log_prob"]) > -0.5
    assert min(info.losses["best_epoch"]) > 0


def test_learns_a_posterior_at_the_end_of_a_uniform_prior():
    # x = p + noise, p = 2 Phi(z) - 1 uniform on [-1, 1]. At x = 1.2 the posterior is at the end
    # of the prior's range, where it is several times wider in z than at x = 0. With splines alone
    # the divergence was 4 to 10 nats.
    noise, seen = 0.1, torch.tensor([1.2])
    problem = make_problem(1, seen)
    method = SNPEC(epochs=10, members=1)
    with seeded(9):
        z = torch.randn(3000, 1)
        x = 2 * NORMAL.cdf(z) - 1 + noise * torch.randn(3000, 1)
        state, _ = method.tell(problem, method.init(problem), z, x)
    with seeded(10):
        p = seen + noise * torch.randn(100_000, 1).double()
        p = p[p < 1 - 1e-6][:, None]
    exact = torch.distributions.Normal(seen.double(), noise)
    z = torch.special.ndtri((p + 1) / 2)
    log_p = exact.log_prob(p) - exact.cdf(torch.ones(1)).log() + NORMAL.log_prob(z) + math.log(2)
    log_q = method.densities(problem, state)[0].log_prob(z.float())
    # The Kullback-Leibler divergence was 0.3 to 0.6 with three seeds.
    assert (log_p[:, 0] - log_q).mean() < 1.5


class Recurrent(nn.Module):
    """A network that vmap cannot evaluate."""

    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(1, 8, batch_first=True)

    def forward(self, x):
        return self.gru(x)[1][0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "build",
    [
        lambda: nn.Sequential(nn.Flatten(), nn.Linear(20, 16), nn.Tanh(), nn.Linear(16, 4)),
        Recurrent,
    ],
)
def test_embedding_network_is_trained_with_the_flow(build):
    # A trajectory whose slope is z: the posterior's standard deviation is at most 0.1.
    time = torch.linspace(0, 1, 20)[:, None]
    problem = make_problem(1, 0.8 * time, build)
    with seeded(2):
        z = torch.randn(1500, 1)
        x = z[:, :, None] * time + 0.05 * torch.randn(1500, 20, 1)
        method = SNPEC(epochs=20, members=2, batch_size=128)
        state, info = method.tell(problem, method.init(problem), z, x)
        samples = Mixture(method.densities(problem, state)).sample(2000)
    assert abs(samples.mean() - 0.8) < 0.15
    assert samples.std() < 0.3
    tensors, values = method.tensors(state)
    restored = method.restore(problem, tensors, values)
    points = torch.linspace(-2, 2, 9)[:, None]
    for ours, theirs in zip(
        method.densities(problem, state), method.densities(problem, restored), strict=True
    ):
        assert torch.equal(ours.log_prob(points), theirs.log_prob(points))


def test_embedding_network_must_return_features():
    problem = make_problem(1, torch.zeros(5), lambda: nn.Flatten(0))
    with pytest.raises(BackendError, match="must map a batch"):
        SNPEC().tell(problem, SNPEC().init(problem), torch.randn(20, 1), torch.randn(20, 5))


def test_says_which_features_of_the_observation_it_clipped(caplog):
    problem = make_problem(1, torch.tensor([0.0, 50.0]))
    with seeded(0), caplog.at_level(logging.WARNING):
        z = torch.randn(100, 1)
        _, info = SNPEC().tell(problem, SNPEC().init(problem), z, torch.randn(100, 2) + z)
    assert info.losses["clipped_features"] == 1
    assert "1 of 2 features" in caplog.text and "[1]" in caplog.text


def test_state_of_another_problem_is_refused():
    problem = make_problem(2, torch.zeros(3))
    tensors, values = SNPEC().tensors(SNPEC().init(problem))
    with pytest.raises(ShapeError, match="its z has shape"):
        SNPEC().restore(make_problem(1, torch.zeros(3)), tensors, values)
    with pytest.raises(BackendError, match="not snpe-c"):
        SNPEC().restore(problem, tensors, values | {"backend": "other"})


@pytest.mark.parametrize(
    "options",
    [
        {"flow": "nice"},
        {"proposals": "narrow"},
        {"members": 0},
        {"hidden": ()},
        {"num_atoms": 1},
        {"outside": 1.0},
        {"validation_fraction": 0.0},
    ],
)
def test_options_are_checked(options):
    (name,) = options
    with pytest.raises(BackendError, match=name):
        SNPEC(**options)
