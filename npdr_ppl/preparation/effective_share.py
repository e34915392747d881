"""The effective share of measurements whose residuals are correlated in time."""

import math

import torch
from torch import Tensor

__all__ = ["effective_share"]

LEAST_STEPS = 8
"""Steps of a segment below which autocorrelation cannot be estimated."""


def effective_share(residual: Tensor, measured: Tensor) -> Tensor:
    """Returns the effective number of a segment's measurements as a share of all, per channel.

    The residuals of the segments are treated as chains, whose effective sample size ArviZ
    estimates. Measurements with this weight give a composite likelihood of the right magnitude
    (Ribatet, Cooley & Davison 2012).

    Args:
        residual: Residuals, ``(plates × segments, steps, channels)``.
        measured: Where there are measurements, ``(segments, steps, channels)``, or
            ``(segments, steps, 1)`` for all channels.
    """
    measured = measured.repeat(len(residual) // len(measured), 1, 1).expand(residual.shape)
    shares = [
        _share(values, taken)
        for values, taken in zip(residual.unbind(-1), measured.unbind(-1), strict=True)
    ]
    return torch.tensor(shares, dtype=torch.float64)


def _share(residual: Tensor, taken: Tensor) -> float:
    """Returns the share of one channel; both are ``(plates × segments, steps)``."""
    from npdr_ppl.arviz_module import ess_of_mean

    count = taken.sum(-1)
    most = int(count.max())
    if most < LEAST_STEPS:
        return 1.0
    # Chains have equal lengths. Whole segments do, unless single measurements are missing.
    is_missing_any = bool((taken[:, 1:] & ~taken[:, :-1]).any())
    least = most - most // LEAST_STEPS if is_missing_any else most
    chosen = torch.nonzero(count >= max(1, least))[:, 0]
    length = int(count[chosen].min())
    if length < LEAST_STEPS:
        return 1.0
    if bool(taken[chosen].all()):
        chains = residual[chosen]
    else:
        chains = torch.stack([residual[i][taken[i]][:length] for i in chosen.tolist()])
    share = ess_of_mean(chains.numpy()) / chains.numel()
    return min(1.0, max(1 / length, share)) if math.isfinite(share) else 1.0
