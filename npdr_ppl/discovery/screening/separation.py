"""Distances between candidates under the recording's excitation, with parameters refitted.

Let I be the information of the candidates' unit changes of the whitened measurements. Initial
states are integrated out and the parameters' span is projected out. The change from candidate i at
its fitted size β_i that candidate j cannot imitate is

    d_ij² = β_i² (I_ii − I_ij I_jj⁻¹ I_ji),        d_ii² = β_i² I_ii
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import Screened

__all__ = ["separation_matrix"]


def separation_matrix(projection: Projection, candidates: Sequence[Screened]) -> Tensor:
    """Returns the distances d, ``(n, n)``.

    Args:
        projection: The fitted hypothesis.
        candidates: The candidates.
    """
    if not candidates:
        return torch.zeros(0, 0, dtype=torch.float64)
    changes = [c.variant.change for c in candidates]
    information = projection.scores(torch.cat(changes, dim=-1)).information
    edges = torch.tensor([0, *(c.shape[-1] for c in changes)]).cumsum(0).tolist()
    spans = [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    result = torch.zeros(len(candidates), len(candidates), dtype=torch.float64)
    for i, own in enumerate(spans):
        sizes = candidates[i].sizes
        for j, other in enumerate(spans):
            left = information[own, own]
            if i != j:
                cross = information[own, other]
                inner = torch.linalg.pinv(information[other, other], hermitian=True)
                left = left - cross @ inner @ cross.mT
            result[i, j] = (sizes @ left @ sizes).clamp_min(0.0).sqrt()
    return result
