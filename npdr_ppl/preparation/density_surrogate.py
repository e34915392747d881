"""A polynomial in place of a posterior's log density, which simulations make slow.

It is fitted to draws whose log density is known. It only proposes points, which the density itself
accepts or rejects; see :func:`~npdr_ppl.inference.parts.samplers.walkers.ensemble_draws`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.preparation.polynomials import Polynomial, fit_polynomial
from npdr_ppl.preparation.sampling_settings import DENSITY_SURROGATE

__all__ = ["DensitySurrogate"]


@dataclass(frozen=True)
class DensitySurrogate:
    """A log density, known near the points that it was fitted to.

    Attributes:
        mean: Mean of the density, ``(d,)``.
        factor: Cholesky factor of its covariance, ``(d, d)``.
        polynomial: By how much the log density exceeds that of a normal density with this mean
            and covariance, of points that are standardised by both.
        farthest: Greatest distance from the mean, in standard deviations; the density is zero
            beyond.
    """

    mean: Tensor
    factor: Tensor
    polynomial: Polynomial
    farthest: float

    @classmethod
    def of(cls, w: Tensor, log_weights: Tensor, log_density: Tensor) -> "DensitySurrogate | None":
        """Fits a polynomial to the points whose density is not too small.

        Args:
            w: Weighted draws of the density, ``(n, d)``.
            log_weights: Logarithms of their weights, ``(n,)``, whose sum is one.
            log_density: Their log density up to a constant, ``(n,)``.

        Returns:
            ``None`` if there are too few points, or the polynomial errs too much.
        """
        weights, d = log_weights.exp(), w.shape[1]
        mean = weights @ w
        away = w - mean
        factor, info = torch.linalg.cholesky_ex((weights[:, None] * away).mT @ away)
        if bool(info):
            return None
        excess = log_density.max() - log_density
        # The excess of draws of a normal density is half a chi-square variable, d/2 on average.
        near = excess < d + DENSITY_SURROGATE.deepest
        if not bool(near.any()):
            return None
        points = torch.linalg.solve_triangular(factor, away[near].mT, upper=False).mT
        polynomial = fit_polynomial(
            points,
            log_density[near, None] + 0.5 * points.square().sum(-1, keepdim=True),
            weights=1.0 / (1.0 + (excess[near] / d)),
            importance=torch.ones(1, dtype=torch.float64),
            most_degree=DENSITY_SURROGATE.most_degree,
            points_per_coefficient=DENSITY_SURROGATE.points_per_coefficient,
            penalties=DENSITY_SURROGATE.penalties,
        )
        if polynomial is None or polynomial.error > DENSITY_SURROGATE.largest_error:
            return None
        return cls(mean, factor, polynomial, float(points.norm(dim=-1).max()))

    def __call__(self, w: Tensor) -> Tensor:
        """Returns the log density up to a constant, ``(n,)``, at points ``(n, d)``."""
        points = torch.linalg.solve_triangular(self.factor, (w - self.mean).mT, upper=False).mT
        squares = points.square().sum(-1)
        value = self.polynomial(points)[:, 0] - 0.5 * squares
        return torch.where(squares <= self.farthest**2, value, -torch.inf)
