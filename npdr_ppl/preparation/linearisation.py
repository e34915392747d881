"""Residuals of a model's segments, and their derivatives at one point."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.preparation.settings import LINEARISATION
from npdr_ppl.preparation.solving import is_invertible, solve_or_zero

__all__ = ["Linearisation", "difference_quotients"]


@dataclass(frozen=True)
class Linearisation:
    """Residuals and their derivatives; S segments of N measurements, d parameters, m offsets.

    Attributes:
        residual: Measurement minus simulation, ``(S, N)``.
        by_parameters: Derivative of the simulation by parameters, ``(S, N, d)``.
        by_starts: Derivative by the offsets of each segment's own initial state, ``(S, N, m)``.
    """

    residual: Tensor
    by_parameters: Tensor
    by_starts: Tensor

    def rescaled(self, factor: Tensor) -> "Linearisation":
        """Returns it in units that are smaller by a factor per channel, ``(C,)``."""
        ratio = factor.repeat(self.residual.shape[-1] // len(factor))
        by_parameters, by_starts = (
            part * ratio[:, None] for part in (self.by_parameters, self.by_starts)
        )
        return Linearisation(self.residual * ratio, by_parameters, by_starts)

    def updated(self, residual: Tensor, step: Tensor, moves: Tensor) -> "Linearisation":
        """Returns the linearisation at a nearby point.

        In each segment, derivatives change as little as the new residuals require (Broyden 1965),
        and less after a move that is shorter than those of the finite differences: what it changes
        may be rounding errors.

        Args:
            residual: Residuals at the point, ``(S, N)``.
            step: Difference of the parameters, ``(d,)``.
            moves: Differences of the offsets, ``(S, m)``.
        """
        both = torch.cat((step.expand(len(moves), -1), moves), dim=-1)[:, None]  # (S, 1, d + m)
        derivatives = torch.cat((self.by_parameters, self.by_starts), dim=-1)
        missed = (self.residual - residual)[..., None] - derivatives @ both.mT
        length = both.square().sum(-1, keepdim=True).clamp_min(LINEARISATION.parameter_step**2)
        derivatives = derivatives + missed * (both / length)
        by_parameters, by_starts = derivatives.split((len(step), moves.shape[-1]), dim=-1)
        return Linearisation(residual, by_parameters, by_starts)

    @property
    def num_bytes(self) -> int:
        """Bytes of memory that it takes."""
        parts = self.residual, self.by_parameters, self.by_starts
        return sum(part.numel() * part.element_size() for part in parts)

    @property
    def is_finite(self) -> bool:
        """Whether residuals and derivatives are finite, and their squares, which are summed later.

        They are not if the simulation fails at the point, or at one of the points next to it that
        the finite differences need.
        """
        parts = self.residual, self.by_parameters, self.by_starts
        return all(bool(part.square().sum().isfinite()) for part in parts)

    @property
    def is_regular(self) -> bool:
        """Whether it is finite and the initial states of every segment can be integrated out.

        They cannot if derivatives by the offsets are so large that 1 + Gᵀ G is singular to working
        precision. The simulation then diverges at points next to this one.
        """
        return self.is_finite and bool(is_invertible(self._inner).all())

    @property
    def _inner(self) -> Tensor:
        """1 + Gᵀ G, ``(S, m, m)``."""
        eye = torch.eye(self.by_starts.shape[-1], dtype=torch.float64)
        return self.by_starts.mT @ self.by_starts + eye

    def weights(self) -> Tensor:
        """Returns C⁻¹ J, ``(S, N, d)``, with the initial states integrated out.

        J is the derivative by the parameters and C = 1 + G Gᵀ the covariance of the residuals,
        with the derivative G by the offsets, which are standard normal. Zero in segments where C
        cannot be inverted, which say nothing about the parameters.
        """
        taken_back, is_solved = self._solved()
        weights = self.by_parameters - self.by_starts @ taken_back
        return torch.where(is_solved[:, None, None], weights, 0.0)

    def taken_back(self) -> Tensor:
        """Returns how the offsets compensate a change of each parameter, ``(S, m, d)``.

        Zero in segments where this cannot be computed; see :attr:`is_regular`.
        """
        return self._solved()[0]

    def _solved(self) -> tuple[Tensor, Tensor]:
        """Returns the compensation, and a mask of segments where it was computed, ``(S,)``."""
        inner = self._inner
        taken_back, is_solved = solve_or_zero(inner, self.by_starts.mT @ self.by_parameters)
        is_solved &= is_invertible(inner)
        return torch.where(is_solved[:, None, None], taken_back, 0.0), is_solved

    def information(self) -> Tensor:
        """Returns the Fisher information Jᵀ C⁻¹ J of the parameters, ``(d, d)``."""
        return (self.by_parameters.mT @ self.weights()).sum(0)


def difference_quotients(
    residuals: Callable[[Tensor, Tensor], Tensor],
    z: Tensor,
    offsets: Tensor,
    moves: Tensor,
    check: Tensor,
    *,
    is_rough: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns derivatives by parameters and by offsets, and residuals, from one batch.

    Args:
        residuals: Returns residuals, ``(n, S, N)``, of parameters, ``(n, d)``, and offsets,
            ``(n, S, m)`` or ``(n, 1, m)``.
        z: Parameters, ``(d,)``.
        offsets: Offsets of the initial states, ``(S, m)``.
        moves: Differences of the offsets, ``(k, m)``.
        check: Further differences, ``(c, m)``, with which residuals are returned.
        is_rough: Whether one-sided differences will do.

    Returns:
        Derivatives by parameters, ``(d, S, N)``, and along the moves, ``(k, S, N)``, per length of
        a move; and residuals, ``(1 + c, S, N)``, the first without any difference.
    """
    d, k, c = len(z), len(moves), len(check)
    shifts = LINEARISATION.parameter_step * torch.eye(d, dtype=torch.float64)
    signs = (1.0,) if is_rough else (1.0, -1.0)
    num = len(signs)
    points = torch.cat([sign * shifts for sign in signs])
    starts = torch.cat([sign * moves for sign in signs] + [check])[:, None]
    unmoved = torch.zeros(num * k + c + 1, d, dtype=torch.float64)
    no_start = torch.zeros(1, 1, offsets.shape[-1], dtype=torch.float64)
    found = residuals(
        z + torch.cat((points, unmoved)),
        offsets + torch.cat((no_start.expand(num * d, -1, -1), starts, no_start)),
    )
    by_z, by_start, checked, here = found.split((num * d, num * k, c, 1))
    if is_rough:
        down, right = here.expand_as(by_z), here.expand_as(by_start)
        up, left = by_z, by_start
    else:
        up, down, left, right = by_z[:d], by_z[d:], by_start[:k], by_start[k:]
    return (
        (down - up) / (num * LINEARISATION.parameter_step),
        (right - left) / (num * LINEARISATION.initial_state_step),
        torch.cat((here, checked)),
    )
