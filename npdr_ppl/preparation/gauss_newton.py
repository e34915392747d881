"""One damped Gauss-Newton step of parameters and initial states; see ``segment_fit.py``.

The offsets of the initial states are eliminated segment by segment, so that the linear system has
the size of the parameters.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.settings import SEGMENT_FIT
from npdr_ppl.preparation.solving import solve_or_zero

__all__ = ["as_moved", "possible_gain", "step"]


def possible_gain(
    now: Linearisation, z: Tensor, offsets: Tensor, held: Tensor, uniform: Tensor
) -> float:
    """Returns by how much the best step would reduce the objective if residuals were linear.

    Args:
        now: Residuals and derivatives.
        z: Parameters, ``(d,)``.
        offsets: Offsets, ``(S, m)``.
        held: Mask of coordinates that are not fitted, ``(d,)``; their derivatives are zero.
        uniform: Mask of coordinates with uniform priors, ``(d,)``.
    """
    system = _System.of(now, z, offsets)
    eye = torch.eye(offsets.shape[-1], dtype=torch.float64)
    parts = solve_or_zero(system.own + eye, system.sides)[0]
    hessian, gradient = system.reduced(parts)
    gradient = gradient.masked_fill(held, 0.0)
    prior = _curvature_of_prior(gradient, z, uniform)
    change = solve_or_zero(hessian + torch.diag(prior), gradient[:, None])[0]
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
    uniform: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns parameters after one damped Gauss-Newton step, and offsets to try with them.

    Derivatives by the coordinate of a uniform prior vanish towards its ends. So steps away from an
    end are linear in the parameter, not in the coordinate: otherwise a fit that is to leave an end
    would take many. A segment whose own system cannot be solved keeps its offsets, which then
    count as known. If the parameters' system cannot be solved, the parameters stay.

    Args:
        now: Residuals and derivatives.
        z: Parameters, ``(d,)``.
        offsets: Offsets, ``(S, m)``.
        held: Mask of coordinates that are not fitted, ``(d,)``; their derivatives are zero.
        damping: Damping of the parameters, relative to their curvatures.
        dampings: Damping of the offsets of each segment, ``(S,)``.
        factors: Multiples of ``dampings`` to try, among them 1.
        uniform: Mask of coordinates with uniform priors, ``(d,)``.

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
    gradient = gradient.masked_fill(held, 0.0)
    prior = _curvature_of_prior(gradient, z, uniform)
    hessian = hessian + torch.diag(prior + damping * hessian.diagonal().maximum(prior))
    change = _limited(hessian, gradient, z, uniform)
    limit = SEGMENT_FIT.largest_coordinate
    share = torch.special.ndtr(z.clamp(-limit, limit))
    quantile = (share + change * _density(z)).clamp(*_ndtr(-limit, limit))
    is_inwards = uniform & (change * z < 0.0)
    inwards = torch.special.ndtri(quantile) - torch.special.ndtri(share)
    moved = (z + torch.where(is_inwards, inwards, change)).clamp(-limit, limit)
    linear = torch.where(is_inwards, change, moved - z)
    begun = [offsets + part[..., d] - part[..., :d] @ linear for part in parts.values()]
    return moved, torch.stack(begun)


def as_moved(
    now: Linearisation, z: Tensor, moved: Tensor, uniform: Tensor
) -> tuple[Linearisation, Tensor]:
    """Returns derivatives at another point, if residuals are linear in uniform parameters.

    Their coordinates are not linear in the parameters, so derivatives by them differ from point
    to point.

    Args:
        now: Residuals and derivatives.
        z: Parameters, ``(d,)``.
        moved: Parameters at the other point, ``(d,)``.
        uniform: Mask of coordinates with uniform priors, ``(d,)``.

    Returns:
        The derivatives by the coordinates at the other point, and the change of the parameters in
        these, to first order, ``(d,)``.
    """
    factors = torch.where(uniform, _density(moved) / _density(z), 1.0)
    shares = (torch.special.ndtr(moved) - torch.special.ndtr(z)) / _density(moved)
    change = torch.where(uniform, shares, moved - z)
    return replace(now, by_parameters=now.by_parameters * factors), change


def _curvature_of_prior(gradient: Tensor, z: Tensor, uniform: Tensor) -> Tensor:
    """Returns the prior's part of the Hessian's diagonal, ``(d,)``.

    The objective has the square of each coordinate. A coordinate at the end of a uniform prior
    changes by hundreds where the parameter changes by a little. So where the data pull it inwards,
    its curvature is that of a normal prior of the parameter, as wide as in the middle. Where
    they pull it outwards, against the prior, the curvature of the objective counts.

    Args:
        gradient: The direction of descent, data and prior together, ``(d,)``.
        z: Parameters, ``(d,)``.
        uniform: Mask of coordinates with uniform priors, ``(d,)``.
    """
    by_data = (gradient + z) * z
    inwards, outwards = (-z.square()).exp(), 1.0 + by_data.clamp_min(0.0)
    return torch.where(uniform, torch.where(by_data < 0.0, inwards, outwards), 1.0)


def _limited(hessian: Tensor, gradient: Tensor, z: Tensor, uniform: Tensor) -> Tensor:
    """Returns a step in which no parameter moves by more than ``longest_step``.

    A parameter that would move by more moves by just that, and the others follow. Were the whole
    step shortened instead, one that has almost no influence would stop all others.

    Args:
        hessian: Matrix of the normal equations, ``(d, d)``.
        gradient: Their right-hand side, ``(d,)``.
        z: Parameters, ``(d,)``.
        uniform: Mask of coordinates with uniform priors, ``(d,)``. Away from the end of its prior,
            such a parameter may move as far as from the middle.
    """
    longest, is_free = SEGMENT_FIT.longest_step, torch.ones_like(uniform)
    middle, end = _ndtr(0.0, longest)
    inwards = torch.where(uniform, (end - middle) / _density(z), longest)
    change = torch.zeros_like(gradient)
    while bool(is_free.any()):
        left = gradient[is_free] - hessian[is_free][:, ~is_free] @ change[~is_free]
        change[is_free] = solve_or_zero(hessian[is_free][:, is_free], left[:, None])[0][:, 0]
        limits = torch.where(change * z < 0.0, inwards, longest)
        excess = (change.abs() / limits).masked_fill(~is_free, 0.0)
        farthest = int(excess.argmax())
        if float(excess[farthest]) <= 1.0:
            break
        change[farthest] = change[farthest].sign() * limits[farthest]
        is_free[farthest] = False
    return change


def _density(z: Tensor) -> Tensor:
    """Returns the density of the standard normal distribution."""
    return (-0.5 * z.square()).exp() / math.sqrt(2.0 * math.pi)


def _ndtr(low: float, high: float) -> tuple[float, float]:
    """Returns probabilities of the standard normal distribution below two numbers."""
    low, high = torch.special.ndtr(torch.tensor([low, high], dtype=torch.float64)).tolist()
    return low, high
