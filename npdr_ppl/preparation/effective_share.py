"""How much a recording says where its residuals are correlated in time."""

import torch
from torch import Tensor

__all__ = ["effective_share"]

MIN_STEPS = 8
"""Steps of a segment below which autocorrelation cannot be estimated."""


def effective_share(residual: Tensor, mask: Tensor) -> Tensor:
    """Returns which share of a segment's readings is worth an independent one, per channel.

    The residuals of the segments are treated as chains, whose effective sample size ArviZ
    estimates; readings weighted by it make a composite likelihood of the right magnitude (Ribatet,
    Cooley & Davison 2012).

    Args:
        residual: Residuals, ``(plates × segments, steps, channels)``.
        mask: Which steps exist, ``(segments, steps)``.
    """
    from npdr_ppl.arviz_module import ess_of_array

    whole = mask.all(-1).repeat(len(residual) // len(mask))
    chains = residual[whole] if bool(whole.any()) else residual
    total = chains.shape[0] * chains.shape[1]
    if chains.shape[1] < MIN_STEPS:
        return torch.ones(residual.shape[-1], dtype=torch.float64)
    sizes = [ess_of_array(values.numpy(), method="mean") for values in chains.unbind(-1)]
    share = torch.tensor(sizes, dtype=torch.float64) / total
    return share.nan_to_num(1.0).clamp(1 / chains.shape[1], 1.0)
