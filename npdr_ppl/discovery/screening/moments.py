"""Forces that act at some moments only, as bursts, impacts or a stop that is hit now and then.

No law of what is recorded is resembled by a force that comes when it likes. But where it acts, the
residuals of a segment lie along what a force would change, and where it does not, they lie
anywhere. In every segment the residuals' energy along the largest responses to pulses is compared
with that in all other directions (an F statistic), and with the same in the segment in the middle,
since coloured noise resembles a force everywhere. A single reading that is far off may lie where
all forces end; the one that speaks most for a force is left out of its segment.

A few segments stand out by chance. Of the k smallest of S tail probabilities the greatest is p
with the probability that at least k of S are below p (higher criticism; Donoho & Jin 2004), and
the least of these over k counts, once for each k. A stop may be hit once, so one segment may speak
alone.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import special
from torch import Tensor

from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.permutation_tests import FEWEST_BLOCKS
from npdr_ppl.discovery.screening.projection import Projection

__all__ = ["Moments", "forces_at_moments"]

SHAPES = 3
"""Directions in which a force may act in one segment: those that change the readings most."""

MOST = 20
"""Segments that are looked at together."""


@dataclass(frozen=True)
class Moments:
    """Whether a force acts at a port at some moments.

    Attributes:
        name: E.g. ``"arm: force at moments"``.
        p_value: Probability of as many segments that stand out by as much, by chance.
        gain: Reduction of the misfit by a force in those segments.
    """

    name: str
    p_value: float
    gain: float


def forces_at_moments(projection: Projection, found: Responses) -> list[Moments]:
    """Tests every joint for a force that acts in some segments.

    Too few segments say nothing, and none with hardly more readings than forces have shapes.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
    """
    residual = projection.whitened(projection.residual[..., None])[..., 0]
    num, size = residual.shape
    if num < FEWEST_BLOCKS or size < SHAPES + 2:
        return []
    result = []
    for port, change in found.by_port.items():
        directions = torch.linalg.svd(projection.whitened(change), full_matrices=False)[0]
        directions = directions[..., :SHAPES]
        shapes = directions.shape[-1]
        along, across = _energies(residual, directions)
        freedom = size - shapes
        usual = float((along / across).median()) * freedom / shapes
        usual = max(1.0, usual / float(special.fdtri(shapes, freedom, 0.5)))
        along, across = _energies_without_one(residual, directions)
        across = across / (freedom - 1)
        ratio = along / shapes / across / usual
        tails = torch.from_numpy(special.fdtrc(shapes, freedom - 1, ratio.numpy()))
        order = tails.argsort()[:MOST]
        least = tails[order].numpy()
        together = special.bdtrc(np.arange(len(order)), num, least)
        best = int(together.argmin())
        stand_out = order[: best + 1]
        gain = (along - shapes * usual * across)[stand_out].sum()
        p_value = min(1.0, len(together) * float(together[best]))
        result.append(Moments(f"{port}: force at moments", p_value, float(gain)))
    return result


def _energies(residual: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the residuals' energy along orthonormal directions and across them, ``(S,)`` each.

    Args:
        residual: Residuals, ``(S, N)``.
        directions: The directions, ``(S, N, k)``.
    """
    along = torch.einsum("snk,sn->sk", directions, residual).square().sum(-1)
    return along, (residual.square().sum(-1) - along).clamp_min(1e-30)


def _energies_without_one(residual: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the same without the reading in each segment that speaks most for the directions.

    Without its row the directions D are no longer orthonormal; by Sherman and Morrison's formula
    (DᵀD)⁻¹ is 1 + d dᵀ / (1 − dᵀd) with d that row.
    """
    scores = torch.einsum("snk,sn->sk", directions, residual)[:, None]
    scores = scores - directions * residual[..., None]  # (S, N, k), each without a reading
    left = (1.0 - directions.square().sum(-1)).clamp_min(1e-9)
    along = scores.square().sum(-1) + (scores * directions).sum(-1).square() / left
    energy = residual.square()
    across = (energy.sum(-1, keepdim=True) - energy - along).clamp_min(1e-30)
    least = (along / across).argmin(-1, keepdim=True)
    return along.gather(-1, least)[:, 0], across.gather(-1, least)[:, 0]
