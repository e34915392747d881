"""One damped Gauss-Newton step of parameters and initial states; see ``segment_fit.py``.

The offsets of the initial states are eliminated segment by segment, so that the linear system has
the size of the parameters.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.settings import SEGMENT_FIT
from npdr_ppl.preparation.solving import solve_or_zero

__all__ = ["possible_gain", "step"]


def possible_gain(now: Linearisation, z: Tensor, offsets: Tensor, held: Tensor) -> float:
    """Returns by how much the best step would reduce the objective if residuals were linear.

    Args:
        now: Residuals and derivatives.
        z: Parameters, ``(d,)``.
        offsets: Offsets, ``(S, m)``.
        held: Mask of coordinates that are not fitted, ``(d,)``; their derivatives are zero.
    """
    system = _System.of(now, z, offsets)
    eye = torch.eye(offsets.shape[-1], dtype=torch.float64)
    parts = solve_or_zero(system.own + eye, system.sides)[0]
    hessian, gradient = system.reduced(parts)
    gradient = gradient.masked_fill(held, 0.0)
    change = solve_or_zero(hessian + torch.eye(len(z), dtype=torch.float64), gradient[:, None])[0]
    by_offsets = (system.sides[..., -1] * parts[..., -1]).sum()
    return float(by_offsets + gradient @ change[:, 0])


@dataclass(frozen=True)
class _System:
    """The normal equations of a Gauss-Newton step, without the prior's and the damping's part.

    Attributes:
        own: Those of each segment's offsets, Gᵀ G, ``(S, m, m)``.
        sides: Gᵀ J and the offsets' gradient, ``(S, m, d + 1)``.
        by_parameters: Jᵀ J, ``(d, d)``.
        gradient: The parameters' gradient, ``(d,)``.
    """

    own: Tensor
    sides: Tensor
    by_parameters: Tensor
    gradient: Tensor

    @classmethod
    def of(cls, now: Linearisation, z: Tensor, offsets: Tensor) -> "_System":
        by_z, by_start, residual = now.by_parameters, now.by_starts, now.residual[..., None]
        pull = by_start.mT @ residual - offsets[..., None]
        return cls(
            by_start.mT @ by_start,
            torch.cat((by_start.mT @ by_z, pull), dim=-1),
            (by_z.mT @ by_z).sum(0),
            (by_z.mT @ residual).sum(0)[:, 0] - z,
        )

    def reduced(self, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the parameters' Hessian and gradient once the offsets are eliminated.

        Each segment's offsets can be, because no other segment depends on them.

        Args:
            parts: The solution of each segment's own system, ``(S, m, d + 1)``.
        """
        d = len(self.gradient)
        taken = (self.sides[..., :d].mT @ parts).sum(0)
        return self.by_parameters - taken[:, :d], self.gradient - taken[:, d]


def step(
    now: Linearisation,
    z: Tensor,
    offsets: Tensor,
    held: Tensor,
    damping: float,
    dampings: Tensor,
    factors: tuple[float, ...],
) -> tuple[Tensor, Tensor]:
    """Returns parameters after one damped Gauss-Newton step, and offsets to try with them.

    A segment whose own system cannot be solved keeps its offsets, which then count as known. If
    the parameters' system cannot be solved, the parameters stay.

    Args:
        now: Residuals and derivatives.
        z: Parameters, ``(d,)``.
        offsets: Offsets, ``(S, m)``.
        held: Mask of coordinates that are not fitted, ``(d,)``; their derivatives are zero.
        damping: Damping of the parameters, relative to their curvatures.
        dampings: Damping of the offsets of each segment, ``(S,)``.
        factors: Multiples of ``dampings`` to try, among them 1.

    Returns:
        Parameters ``(d,)``, and offsets for each factor, ``(b, S, m)``.
    """
    system, d = _System.of(now, z, offsets), len(z)
    eye = torch.eye(offsets.shape[-1], dtype=torch.float64)
    parts = {
        f: solve_or_zero(system.own + (1.0 + f * dampings)[:, None, None] * eye, system.sides)[0]
        for f in factors
    }
    hessian, gradient = system.reduced(parts[1.0])
    curvature = hessian.diagonal().clamp_min(1.0)
    hessian = hessian + torch.diag(1.0 + damping * curvature)
    change = solve_or_zero(hessian, gradient.masked_fill(held, 0.0)[:, None])[0][:, 0]
    change = change * min(
        1.0, SEGMENT_FIT.longest_step / float(change.abs().max().clamp_min(1e-12))
    )
    moved = (z + change).clamp(-SEGMENT_FIT.largest_coordinate, SEGMENT_FIT.largest_coordinate)
    begun = [offsets + part[..., d] - part[..., :d] @ (moved - z) for part in parts.values()]
    return moved, torch.stack(begun)
