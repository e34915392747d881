"""When a law counts as a help, and with what it is compared."""

import math

import torch

from npdr_ppl.discovery.learning.proof import SIGNIFICANT, Check
from npdr_ppl.discovery.learning.result import _within


def test_a_law_helps_if_it_reduces_the_misfit_by_more_than_the_noise_does():
    assert Check("a half", 1.2, 1.0, 0.05).helps
    assert not Check("a half", 1.0 + 0.9 * SIGNIFICANT * 0.05, 1.0, 0.05).helps
    assert not Check("a half", 1.0, 1.0 + 1e-9, 0.0).helps


def test_a_law_that_does_not_simulate_does_not_help():
    assert not Check("a half", 1.0, math.inf).helps
    assert not Check("a half", math.inf, math.inf).helps
    assert Check("a half", math.inf, 1.0).helps


def test_coefficients_beyond_a_limit_stay_at_it_while_the_others_are_fitted_again():
    generator = torch.Generator().manual_seed(0)
    columns = torch.randn(50, 2, generator=generator, dtype=torch.float64)
    target = columns @ torch.tensor([2.0, -1.0], dtype=torch.float64)
    infinite = torch.full((2,), math.inf, dtype=torch.float64)
    free = _within(columns, target, -infinite, infinite)
    assert torch.allclose(free, torch.tensor([2.0, -1.0], dtype=torch.float64))
    positive = _within(columns, target, torch.zeros(2, dtype=torch.float64), infinite)
    alone = torch.linalg.lstsq(columns[:, :1], target[:, None]).solution
    assert float(positive[1]) == 0.0
    assert torch.allclose(positive[:1], alone[:, 0])
