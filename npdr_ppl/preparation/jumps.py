"""Segments in which the simulation jumps as parameters change, as where a foot touches down.

A difference quotient takes a jump for a steep slope, so that a few such segments seem to tell more
than all others: intervals come out too narrow, and parameters wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import SegmentFit
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.settings import LINEARISATION

__all__ = ["Jumps", "jumps_of"]

_NUM_PARTS = 64
"""Parts into which the width of a difference quotient is divided to find a jump in one of them. A
straight line changes as much in each, and a kink in each on one side of it."""

_MOST = 0.5
"""Least share of a change that happens in one of the parts at a jump."""

_MISLEADING = 0.1
"""Share of what a recording seems to tell about a parameter, above which the user is warned if it
comes from jumps. On a leg that squats and hops, it is 0.19 to 0.96 for four parameters, whose
errors are up to 435 standard deviations, and below 0.001 for the others."""


@dataclass(frozen=True)
class Jumps:
    """Where a simulation jumps as its parameters change.

    Attributes:
        is_jump: The segments, ``(S,)``.
        shares: Share of the apparent information about each coordinate that jumps make up,
            ``(d,)``.
        names: Name of each coordinate's parameter.
    """

    is_jump: Tensor
    shares: Tensor
    names: Sequence[str]

    @property
    def misled(self) -> tuple[str, ...]:
        """The parameters about which jumps seem to tell much."""
        is_misled = (self.shares > _MISLEADING).tolist()
        return tuple(dict.fromkeys(n for n, m in zip(self.names, is_misled, strict=True) if m))

    def __str__(self) -> str:
        """A sentence for users; empty if no parameter is concerned."""
        if not self.misled:
            return ""
        return (
            f"The simulation jumps in {int(self.is_jump.sum())} of {len(self.is_jump)} segments, "
            "as where something touches or slips, so that values can be wrong by many times their "
            f"intervals: {', '.join(self.misled)}. Fit them on a recording without contacts."
        )


def jumps_of(likelihood: SegmentLikelihood) -> Jumps:
    """Finds the segments in which the simulation jumps near the closest fit.

    Within the width of the difference quotients, a segment jumps if most of its change happens in
    one of many parts. Only changes by more than an average segment's are looked at.

    Args:
        likelihood: The likelihood at the closest fit.
    """
    half, num_segments = LINEARISATION.parameter_step, len(likelihood.fit.offsets)
    here = _at(likelihood, likelihood.fit.z[None])
    told, is_bent = [], []
    for k in range(d := len(likelihood.fit.z)):  # one by one, to bound the memory
        down, up = _at(likelihood, _moved(likelihood.fit.z, k, torch.tensor([-half, half])))
        change = (up - down).norm(dim=-1)
        is_bent.append((up - 2.0 * here[0] + down).norm(dim=-1) > _MOST * change)
        told.append((change / (2.0 * half)).square().nan_to_num(0.0))
    told, is_bent = torch.stack(told), torch.stack(is_bent)  # (d, S)
    total = told.sum(1, keepdim=True) + 1.0
    is_jump = is_bent & (told > total / num_segments)
    index = is_jump.any(0).nonzero()[:, 0]
    if len(index):
        steep = _steep(_along(likelihood, index), is_jump[:, index].any(1))
        is_jump[:, index] &= steep
    return Jumps(
        is_jump.any(0),
        (told * is_jump).sum(1) / total[:, 0],
        [
            s.name
            for s in likelihood.segments.prior.sites
            for _ in range(*s.coordinates.indices(d))
        ],
    )


def _steep(likelihood: SegmentLikelihood, wanted: Tensor) -> Tensor:
    """Returns where most of a change happens in one part of its width, ``(d, S)``.

    Args:
        likelihood: The likelihood of some segments.
        wanted: Mask of the coordinates to change, ``(d,)``.
    """
    half = LINEARISATION.parameter_step
    places = torch.linspace(-half, half, _NUM_PARTS + 1)
    result = torch.zeros(len(wanted), len(likelihood.fit.offsets), dtype=torch.bool)
    for k in wanted.nonzero()[:, 0].tolist():
        parts = _at(likelihood, _moved(likelihood.fit.z, k, places)).diff(dim=0).norm(dim=-1)
        result[k] = parts.amax(0) > _MOST * parts.sum(0)
    return result


def _at(likelihood: SegmentLikelihood, z: Tensor) -> Tensor:
    """Returns whitened residuals at points ``(n, d)``, ``(n, S, N)``."""
    return likelihood.whitened(z).unflatten(1, (len(likelihood.fit.offsets), -1))


def _moved(z: Tensor, k: int, by: Tensor) -> Tensor:
    """Returns a point ``(d,)`` with one coordinate moved by n differences, ``(n, d)``."""
    points = z.repeat(len(by), 1)
    points[:, k] += by
    return points


def _along(likelihood: SegmentLikelihood, index: Tensor) -> SegmentLikelihood:
    """Returns the likelihood of some of the segments, up to the scale of the noise."""
    fit, now = likelihood.fit, likelihood.linearisation
    return replace(
        likelihood,
        segments=likelihood.segments.along(index),
        fit=SegmentFit(fit.z, fit.offsets[index], fit.scale),
        linearisation=Linearisation(
            now.residual[index], now.by_parameters[index], now.by_starts[index]
        ),
    )
