"""Forces that act at some moments only, as bursts, impacts or a stop that is hit now and then.

No law of what is recorded is resembled by a force that comes when it likes. But where it acts, the
residuals of a segment lie along what a force would change, and where it does not, they lie
anywhere. In every segment the residuals' energy along the largest responses to pulses is compared
with that in all other directions (an F statistic), and with the same in the segment in the middle,
since coloured noise resembles a force everywhere. Outliers enlarge what they are compared with.

A few segments stand out by chance. Of the k smallest of S tail probabilities the greatest is p
with the probability that at least k of S are below p (higher criticism; Donoho & Jin 2004), and
the least of these over k counts, once for each k. A stop may be hit once, so one segment may speak
alone.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import special

from npdr_ppl.workflows.discovery.chance import FEWEST_BLOCKS
from npdr_ppl.workflows.discovery.latent_force import Responses
from npdr_ppl.workflows.discovery.projection import Projection

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
    """Tests every joint for a force that acts in some segments; too few segments say nothing.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
    """
    residual = projection.whitened(projection.residual[..., None])
    num, size = residual.shape[:2]
    if num < FEWEST_BLOCKS:
        return []
    whole = residual.square().sum((1, 2))
    result = []
    for port, change in found.by_port.items():
        directions = torch.linalg.svd(projection.whitened(change), full_matrices=False)[0]
        directions = directions[..., :SHAPES]
        shapes = directions.shape[-1]
        along = (directions.mT @ residual).square().sum((1, 2))
        across = (whole - along).clamp_min(1e-30) / (size - shapes)
        ratio = along / shapes / across
        usual = float(ratio.median()) / float(special.fdtri(shapes, size - shapes, 0.5))
        usual = max(1.0, usual)
        tails = torch.from_numpy(special.fdtrc(shapes, size - shapes, (ratio / usual).numpy()))
        order = tails.argsort()[:MOST]
        least = tails[order].numpy()
        together = special.bdtrc(np.arange(len(order)), num, least)
        best = int(together.argmin())
        stand_out = order[: best + 1]
        gain = (along - shapes * usual * across)[stand_out].sum()
        p_value = min(1.0, len(together) * float(together[best]))
        result.append(Moments(f"{port}: force at moments", p_value, float(gain)))
    return result
