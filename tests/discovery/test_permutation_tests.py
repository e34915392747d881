"""Permutation tests: chance gives uniform p-values, and an effect the smallest one."""

import math

import torch

from npdr_ppl.discovery.screening.permutation_tests import LargestStatistic, _in_span
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.sensitivities import sensitivities
from npdr_ppl.discovery.screening.settings import PERMUTATION_TEST
from npdr_ppl.models.effects import QuadraticDrag


def test_no_p_value_is_below_one_in_the_number_of_draws(dragged):
    _, hypothesis = dragged
    generator = torch.Generator().manual_seed(0)
    shape = (*hypothesis.linearisation.residual.shape, 1)
    found = LargestStatistic(Projection(hypothesis), seed=0, draws=100)
    for _ in range(20):
        (value,) = found.p_values([torch.randn(shape, generator=generator).double()])
        assert value >= 1 / 100


def test_chance_gives_uniform_p_values(quiet):
    projection = Projection(quiet)
    generator = torch.Generator().manual_seed(3)
    shape = (*quiet.linearisation.residual.shape, 1)
    smallest = []
    for seed in range(40):
        columns = [torch.randn(shape, generator=generator).double() for _ in range(5)]
        smallest.append(min(LargestStatistic(projection, seed=seed, draws=400).p_values(columns)))
    # 40 uniform draws: fewer than three below 0.005, and a mean within four standard errors.
    assert sum(p < 0.005 for p in smallest) < 3
    assert abs(sum(smallest) / 40 - 0.5) < 4 * math.sqrt(1 / 12 / 40)


def test_a_hidden_drag_has_the_smallest_p_value(dragged):
    _, hypothesis = dragged
    (variant,) = sensitivities(hypothesis, (QuadraticDrag("hinge"),))
    values = LargestStatistic(Projection(hypothesis), seed=0, draws=400).p_values([variant.change])
    assert values == [1 / 400]


class WhiteNoise:
    """Stands for a fitted hypothesis whose residuals are white, with nothing to refit."""

    def __init__(self, residual):
        self.residual = residual

    def whitened(self, columns):
        return columns

    projected = whitened


def test_scores_are_those_of_the_definition():
    """Blocks of two segments, each weighted by its own spread; candidates of two strengths."""
    generator = torch.Generator().manual_seed(0)
    residual = torch.randn(60, 20, generator=generator).double()
    changes = torch.randn(60, 20, 3, 2, generator=generator).double()
    found = LargestStatistic(WhiteNoise(residual), seed=0, draws=10)
    weights = (changes * found._spread[..., None]).unflatten(0, (30, 2)).flatten(1, 2)
    signals = (changes / found._spread[..., None]).unflatten(0, (30, 2)).flatten(1, 2)
    signals = signals / signals.square().sum((0, 1)).sqrt()
    wanted = torch.einsum("bnpk,cn->pbck", weights, found._standard)
    scale = (wanted.square().sum((1, 2)) / 30).sqrt()
    scores, expected = found._scores(changes, found._standard)
    torch.testing.assert_close(scores, wanted / scale[:, None, None])
    torch.testing.assert_close(
        expected, torch.einsum("bnpk,cnpl->pbckl", weights / scale, signals)
    )


def test_an_effect_in_only_one_segment_is_detected():
    """A permutation that could leave a segment its own residuals would not detect it."""
    generator = torch.Generator().manual_seed(0)
    residual = torch.randn(30, 20, generator=generator).double()
    columns = torch.zeros(30, 20, 1).double()
    columns[7] = torch.randn(20, 1, generator=generator).double()
    columns[7] /= columns[7].norm()
    others = [torch.randn(30, 20, 1, generator=generator).double() for _ in range(40)]

    def p_value(size):
        changed = WhiteNoise(residual + size * columns[..., 0])
        return LargestStatistic(changed, seed=0).p_values([columns, *others])[0]

    assert p_value(0.0) > 0.05
    assert p_value(6.0) < 0.01  # at least 1 / 60 if it kept its own


def test_smooth_responses_need_few_elements_of_a_basis():
    # Responses to pulses of force of sixty blocks, in units that differ by a factor of 1e4.
    generator = torch.Generator().manual_seed(0)
    time = torch.linspace(0.0, 1.0, 700, dtype=torch.float64)
    rates = 1.0 + 5.0 * torch.rand(60, 1, 10, generator=generator, dtype=torch.float64)
    since = (time[:, None] - torch.linspace(0.0, 0.9, 10, dtype=torch.float64)).clamp_min(0.0)
    columns = since**2 * torch.exp(-rates * since) * torch.logspace(0, 4, 10, dtype=torch.float64)
    residuals = torch.randn(60, 700, generator=generator, dtype=torch.float64)
    turned, left = _in_span(columns, residuals)
    assert turned.shape[1] < 150 and left.shape == turned.shape[:2]
    size = columns.square().sum((0, 1)).sqrt()
    scores = torch.einsum("bnc,an->bac", columns, residuals)
    close = torch.einsum("bnc,an->bac", turned, left)
    largest = PERMUTATION_TEST.lost_in_span * residuals.norm(dim=-1)[:, None] * size
    assert ((scores - close).abs() < largest).all()
    rough = torch.randn(80, 700, 10, generator=generator, dtype=torch.float64)
    assert _in_span(rough, torch.ones(80, 700, dtype=torch.float64))[0] is rough
