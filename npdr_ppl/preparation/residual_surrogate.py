"""Polynomials in place of a recording's residuals, which simulations make slow.

The likelihood is −½ |q|² of whitened residuals q, one number for each measurement. A polynomial
for each of them needs far fewer simulations than one for the log density, of which a simulation
gives only one value. The squares of quadratic polynomials have curved ridges, too.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.preparation.polynomials import fit_polynomial, monomials, num_terms
from npdr_ppl.preparation.sampling_settings import RESIDUAL_SURROGATE

__all__ = ["ResidualSurrogate"]


@dataclass(frozen=True)
class ResidualSurrogate:
    """A log likelihood whose residuals are polynomials, known near the points of their fit.

    Attributes:
        middle: Origin of the polynomials, ``(d,)``.
        scale: Scale of their variables, ``(d,)``.
        degree: Their degree.
        squares: Products of their coefficients, summed over the residuals, ``(terms, terms)``.
        inverse: Inverse of the information about their coefficients, ``(terms, terms)``.
        farthest: Leverage of the farther points of the fit, each as if it were left out.
    """

    middle: Tensor
    scale: Tensor
    degree: int
    squares: Tensor
    inverse: Tensor
    farthest: float

    @classmethod
    def of(
        cls, w: Tensor, gram: Tensor, middle: Tensor, scale: Tensor
    ) -> "ResidualSurrogate | None":
        """Fits polynomials to the points with the smallest residuals.

        Args:
            w: Points, ``(n, d)``.
            gram: Products of their whitened residuals, q_i · q_j, ``(n, n)``.
            middle: Origin of the polynomials, ``(d,)``.
            scale: Scale of their variables, e.g. standard deviations, ``(d,)``.

        Returns:
            ``None`` if there are too few points.
        """
        settings, d = RESIDUAL_SURROGATE, w.shape[1]
        # The prior does not count: where only the prior tells, points may be far apart.
        excess = 0.5 * (gram.diagonal() - gram.diagonal().min())
        # The excess of draws of a normal density is half a chi-square variable, d/2 on average.
        num = max(
            round(settings.points_per_term * num_terms(d, 2)),
            int((excess < settings.near * d).sum()),
            len(w) // 2,
        )
        chosen = excess.argsort()[:num]
        weights = (1.0 + excess[chosen] / d).rsqrt()
        # The polynomials depend on the residuals by their products only, so that residuals in
        # fewer dimensions with the same products have the same polynomials. Weights first: large
        # residuals would drown the others.
        products = weights[:, None] * gram[chosen][:, chosen] * weights
        sizes, vectors = torch.linalg.eigh(products)
        residuals = vectors * sizes.clamp_min(0.0).sqrt() / weights[:, None]
        points = (w[chosen] - middle) / scale
        found = fit_polynomial(
            points,
            residuals,
            weights=weights,
            importance=torch.ones(residuals.shape[1], dtype=torch.float64),
            least_degree=2,
            most_degree=settings.most_degree,
            points_per_coefficient=1,
            penalties=settings.penalties,
        )
        if found is None:
            return None
        terms = weights[:, None] * monomials(points, found.degree)
        ridge = settings.least_penalty * len(points) * torch.eye(terms.shape[1]).double()
        inverse = torch.linalg.inv(terms.mT @ terms + ridge)
        squares = found.coefficients @ found.coefficients.mT
        leverages = _products(terms, inverse)
        # As if each point were left out: of a fit with few points, it has a far smaller leverage
        # than a point that is not in the fit.
        left_out = leverages / weights.square() / (1.0 - leverages).clamp_min(1e-3)
        farthest = float(left_out.quantile(settings.inside_share))
        return cls(middle, scale, found.degree, squares, inverse, farthest)

    def __call__(self, w: Tensor, reach: float = 1.0) -> Tensor:
        """Returns the log likelihood up to a constant, ``(n,)``, at points ``(n, d)``.

        Args:
            w: The points.
            reach: Leverage, in units of that of the farther points of the fit, from which on the
                polynomials are not trusted. The log likelihood is minus infinity there.
        """
        terms = monomials((w - self.middle) / self.scale, self.degree)
        is_known = self._leverage(terms) <= reach
        return torch.where(is_known, -0.5 * _products(terms, self.squares), -torch.inf)

    def leverage(self, w: Tensor) -> Tensor:
        """Returns how far points ``(n, d)`` are from those of the fit, ``(n,)``; see above."""
        return self._leverage(monomials((w - self.middle) / self.scale, self.degree))

    def _leverage(self, terms: Tensor) -> Tensor:
        return _products(terms, self.inverse) / self.farthest


def _products(terms: Tensor, matrix: Tensor) -> Tensor:
    """Returns tᵀ A t of each row t of terms, ``(n,)``."""
    return ((terms @ matrix) * terms).sum(-1)
