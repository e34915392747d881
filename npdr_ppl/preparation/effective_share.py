"""The effective share of measurements whose residuals are correlated in time."""

import torch
from torch import Tensor

__all__ = ["effective_share"]

LEAST_STEPS = 8
"""Steps of a segment below which autocorrelation cannot be estimated."""


def effective_share(residual: Tensor, mask: Tensor) -> Tensor:
    """Returns the effective number of a segment's measurements as a share of all, per channel.

    The residuals of the segments are treated as chains, whose effective sample size ArviZ
    estimates. Measurements with this weight give a composite likelihood of the right magnitude
    (Ribatet, Cooley & Davison 2012).

    Args:
        residual: Residuals, ``(plates × segments, steps, channels)``.
        mask: Which steps exist, ``(segments, steps)``.
    """
    from npdr_ppl.arviz_module import ess_of_mean

    whole = mask.all(-1).repeat(len(residual) // len(mask))
    chains = residual[whole] if bool(whole.any()) else residual
    total = chains.shape[0] * chains.shape[1]
    if chains.shape[1] < LEAST_STEPS:
        return torch.ones(residual.shape[-1], dtype=torch.float64)
    sizes = [ess_of_mean(values.numpy()) for values in chains.unbind(-1)]
    share = torch.tensor(sizes, dtype=torch.float64) / total
    return share.nan_to_num(1.0).clamp(1 / chains.shape[1], 1.0)
