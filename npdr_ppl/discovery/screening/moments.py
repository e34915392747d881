"""Forces that act at some moments only, such as bursts, impacts or a stop that is hit rarely.

A force at arbitrary times resembles no law of the recorded channels. But in a segment where it
acts, the residuals lie along the changes that a force would cause. In other segments they have no
preferred direction. In every segment, the residuals' energy along the largest responses to pulses
is compared with the energy in all other directions (an F statistic). Coloured noise resembles a
force everywhere, so this ratio is also compared with its median over the segments. A single
outlier can resemble the end of every force's response. So each segment leaves out the measurement
that supports a force most.

A few segments stand out by chance. Let p be the k-th smallest of S tail probabilities. Its p-value
is the probability that at least k of S are below p (higher criticism; Donoho & Jin 2004). The
least p-value over k is multiplied by the number of k that were tried. A stop may be hit once, so a
single segment can be enough.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import special
from torch import Tensor

from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.settings import MOMENT_TEST, PERMUTATION_TEST

__all__ = ["Moments", "forces_at_moments"]


@dataclass(frozen=True)
class Moments:
    """Whether a force acts at a port at some moments.

    Attributes:
        name: E.g. ``"arm: force at moments"``.
        p_value: Probability that as many segments stand out by as much, by chance.
        gain: Reduction of the misfit by a force in those segments.
    """

    name: str
    p_value: float
    gain: float


def forces_at_moments(projection: Projection, found: Responses) -> list[Moments]:
    """Tests every joint for a force that acts in some segments.

    The result is empty if there are too few segments, or too few measurements in a segment.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
    """
    # The last segment of a rollout may have only a few measurements.
    large = projection.num_measured >= MOMENT_TEST.num_directions + 2
    num, size = int(large.sum()), projection.num_measured[large]
    if num < PERMUTATION_TEST.least_blocks:
        return []
    residual = projection.whitened(projection.residual[..., None])[large][..., 0]
    result = []
    for port, change in found.by_port.items():
        changes = projection.whitened(change)[large]
        directions = torch.linalg.svd(changes, full_matrices=False)[0]
        directions = directions[..., : MOMENT_TEST.num_directions]
        shapes = directions.shape[-1]
        along, across = _energies(residual, directions)
        freedom = (size - shapes).double()
        middle = torch.from_numpy(special.fdtri(shapes, freedom.numpy(), 0.5))
        usual = max(1.0, float((along / across * freedom / shapes / middle).median()))
        along, across = _energies_without_one(residual, directions)
        across = across / (freedom - 1.0)
        ratio = along / shapes / across / usual
        tails = torch.from_numpy(special.fdtrc(shapes, freedom.numpy() - 1.0, ratio.numpy()))
        order = tails.argsort()[: MOMENT_TEST.most_segments]
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
    """Returns the same without each segment's measurement that supports the directions most.

    Without its row d, the directions D are no longer orthonormal. By Sherman and Morrison's
    formula, (DᵀD)⁻¹ is 1 + d dᵀ / (1 − dᵀd).
    """
    scores = torch.einsum("snk,sn->sk", directions, residual)[:, None]
    scores = scores - directions * residual[..., None]  # (S, N, k), each without a measurement
    left = (1.0 - directions.square().sum(-1)).clamp_min(1e-9)
    along = scores.square().sum(-1) + (scores * directions).sum(-1).square() / left
    energy = residual.square()
    across = (energy.sum(-1, keepdim=True) - energy - along).clamp_min(1e-30)
    least = (along / across).argmin(-1, keepdim=True)
    return along.gather(-1, least)[:, 0], across.gather(-1, least)[:, 0]
