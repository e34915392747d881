"""Weights of draws: the longest tempering step, and resampling to equal weights."""

import torch
from torch import Tensor

__all__ = ["longest_step", "systematic"]

BISECTIONS = 40


def longest_step(log_weight: Tensor, longest: float, effective_share: float) -> float:
    """Returns the longest step of the exponent that keeps an effective share of draws.

    Args:
        log_weight: Logarithms of the weights at an exponent of one, ``(n,)``; draws with values
            that are not finite have no weight, and are not part of the share.
        longest: Upper limit of the step.
        effective_share: Effective sample size to keep, as a share of the draws with finite values.
    """

    def share(step: float) -> float:
        tempered = torch.where(log_weight.isfinite(), step * log_weight, -torch.inf)
        effective = 2 * tempered.logsumexp(0) - (2 * tempered).logsumexp(0)
        return float(effective.exp()) / len(log_weight)

    target = effective_share * float(log_weight.isfinite().double().mean())
    if share(longest) >= target:
        return longest
    low, high = 0.0, longest
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if share(middle) >= target:
            low = middle
        else:
            high = middle
    return max(low, torch.finfo(torch.float64).tiny)


def systematic(log_weight: Tensor, num: int) -> Tensor:
    """Returns systematically resampled indices (Douc & Cappé 2005), ``(num,)``."""
    edges = torch.softmax(log_weight, 0).cumsum(0)
    points = (torch.arange(num, dtype=torch.float64) + torch.rand((), dtype=torch.float64)) / num
    return torch.searchsorted(edges, points * edges[-1]).clamp(max=len(log_weight) - 1)
