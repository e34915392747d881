"""Moves of an ensemble keep a density, and lead narrow walkers to its ends."""

import torch

from npdr_ppl.inference.parts.samplers.walkers import ensemble_draws


def drawn(log_density, walkers, seed=0, sweeps=60, **options):
    generator = torch.Generator().manual_seed(seed)
    return ensemble_draws(
        log_density, walkers, sweeps=sweeps, interval=5, generator=generator, **options
    )


def test_a_narrow_ensemble_spreads_to_a_correlated_normal_density():
    factor = torch.tensor([[1.0, 0.0, 0.0], [0.99, 0.1, 0.0], [-0.5, 0.0, 3.0]]).double()
    inverse = torch.linalg.inv(factor)
    begin = 0.5 * torch.randn(400, 3, generator=torch.Generator().manual_seed(1)).double()
    found = drawn(lambda z: -0.5 * (z @ inverse.T).square().sum(-1), begin @ factor.T)
    assert len(found) == 400 * 6
    expected = factor @ factor.T
    assert torch.allclose(found.T.cov(), expected, rtol=0.12, atol=0.12)


def test_walkers_stay_on_the_support():
    begin = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)).double()

    def uniform(z):
        return torch.where(((z > 0.0) & (z < 1.0)).all(-1), 0.0, -torch.inf)

    found = drawn(uniform, begin, sweeps=40)
    assert ((found > 0.0) & (found < 1.0)).all()
    assert torch.allclose(found.mean(0), torch.full((2,), 0.5).double(), atol=0.04)
    assert torch.allclose(found.std(0), torch.full((2,), 12**-0.5).double(), atol=0.02)


def test_the_seed_decides_the_draws():
    begin = torch.randn(50, 2, generator=torch.Generator().manual_seed(0)).double()

    def normal(z):
        return -0.5 * z.square().sum(-1)

    assert torch.equal(drawn(normal, begin), drawn(normal, begin))
    assert not torch.equal(drawn(normal, begin), drawn(normal, begin, seed=1))


def test_a_surrogate_that_is_wrong_changes_nothing_but_the_speed():
    factor = torch.tensor([[1.0, 0.0], [0.9, 0.3]]).double()
    inverse = torch.linalg.inv(factor)

    def correct(z):
        return -0.5 * (z @ inverse.T).square().sum(-1)

    def shifted_and_cut_off(z):
        away = (z - torch.tensor([0.4, 0.2])) @ inverse.T
        return torch.where(z[:, 0] < 2.0, -0.6 * away.square().sum(-1), -torch.inf)

    begin = 0.3 * torch.randn(600, 2, generator=torch.Generator().manual_seed(1)).double()
    found = drawn(correct, begin @ factor.T, sweeps=40, surrogate=shifted_and_cut_off)
    assert torch.allclose(found.mean(0), torch.zeros(2).double(), atol=0.06)
    assert torch.allclose(found.T.cov(), factor @ factor.T, rtol=0.08, atol=0.05)
    share = float((found[:, 0] > 2.0).double().mean())
    assert abs(share - 0.0228) < 0.008


def test_a_surrogate_leads_a_narrow_ensemble_to_the_ends_in_few_sweeps():
    begin = 0.3 * torch.randn(256, 6, generator=torch.Generator().manual_seed(1)).double()

    def normal(z):
        return -0.5 * z.square().sum(-1)

    alone, led = (drawn(normal, begin, sweeps=8, surrogate=s).std() for s in (None, normal))
    assert alone < 0.9
    assert abs(led - 1.0) < 0.05
