"""The effective share of correlated measurements is that of closed forms."""

import pytest
import torch

from npdr_ppl.preparation.effective_share import effective_share


def autoregressive(rho, *, segments=200, steps=100):
    """Returns residuals of one channel whose neighbours have the correlation ``rho``."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(segments, steps, generator=generator, dtype=torch.float64)
    result = noise.clone()
    for k in range(1, steps):
        result[:, k] = rho * result[:, k - 1] + (1.0 - rho**2) ** 0.5 * noise[:, k]
    return result[..., None]


def test_correlated_residuals_count_as_fewer_measurements():
    both = torch.cat((autoregressive(0.0), autoregressive(0.8)), dim=-1)
    mask = torch.ones(*both.shape[:2], 1, dtype=torch.bool)
    share = effective_share(both, mask)
    # (1 − ρ) / (1 + ρ); 200 segments of 100 steps give it to some per cent.
    assert share.tolist() == pytest.approx([1.0, 0.2 / 1.8], rel=0.15)


def test_no_measurement_counts_more_than_once_or_a_segment_less_than_one():
    mask = torch.ones(200, 100, 1, dtype=torch.bool)
    assert effective_share(autoregressive(-0.8), mask).item() == 1.0
    constant = torch.linspace(-1.0, 1.0, 200, dtype=torch.float64)[:, None, None]
    alike = effective_share(constant.expand(200, 100, 1), mask)
    assert alike.item() == pytest.approx(0.01, rel=0.1)


def test_segments_too_short_for_a_correlation_count_in_full():
    residual = autoregressive(0.8, steps=7)
    assert effective_share(residual, torch.ones(200, 7, 1, dtype=torch.bool)).item() == 1.0


def test_segments_that_end_early_are_left_out():
    residual = autoregressive(0.8)
    mask = torch.ones(200, 100, 1, dtype=torch.bool)
    mask[100:, 50:] = False
    padded = residual.clone()
    padded[100:, 50:] = 0.0
    expected = effective_share(residual[:100], mask[:100])
    assert torch.equal(effective_share(padded, mask), expected)


def test_measurements_that_are_missing_do_not_break_the_correlation():
    residual = autoregressive(0.8)
    taken = torch.zeros(200, 100, 1, dtype=torch.bool)
    taken[:, ::2] = True
    share = effective_share(torch.where(taken, residual, 0.0), taken)
    expected = effective_share(residual[:, ::2], taken[:, ::2])
    assert torch.equal(share, expected)
