"""Polynomials in several variables, fitted by weighted least squares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor

__all__ = ["Polynomial", "fit_polynomial", "monomials", "num_terms"]


@dataclass(frozen=True)
class Polynomial:
    """A polynomial of k variables with m values.

    Attributes:
        coefficients: Coefficients of the monomials, ``(terms, m)``.
        degree: The degree.
        error: Root of the weighted mean square of the leave-one-out errors of its fit.
    """

    coefficients: Tensor
    degree: int
    error: float = 0.0

    @classmethod
    def zero(cls, num_values: int) -> "Polynomial":
        """Returns the polynomial that is zero everywhere."""
        return cls(torch.zeros(1, num_values, dtype=torch.float64), 0)

    def __call__(self, points: Tensor) -> Tensor:
        """Returns its values, ``(n, m)``, at points ``(n, k)``."""
        return monomials(points, self.degree) @ self.coefficients


def fit_polynomial(
    points: Tensor,
    values: Tensor,
    *,
    weights: Tensor,
    importance: Tensor,
    most_degree: int,
    least_degree: int = 1,
    points_per_coefficient: int,
    penalties: Sequence[float] = (0.0,),
) -> Polynomial | None:
    """Returns the polynomial with the smallest leave-one-out error.

    Args:
        points: Points, ``(n, k)``.
        values: Values there, ``(n, m)``.
        weights: Square roots of the points' weights, ``(n,)``.
        importance: Weights of the m squared errors in the choice of the degree, ``(m,)``.
        most_degree: Greatest degree.
        least_degree: Least degree.
        points_per_coefficient: There must be more than this many points for each coefficient.
        penalties: Penalties of squared coefficients, per point, of which the best is taken (ridge
            regression). The constant is not penalised.

    Returns:
        ``None`` if there are too few points, or no degree can be fitted.
    """
    found, least = None, torch.inf
    weight = weights[:, None]
    middle = (weight.square() * values).sum(0) / weight.square().sum()
    wanted = weight * (values - middle)
    for degree in range(least_degree, most_degree + 1):
        # With as many coefficients as points, the error says nothing about the degree.
        if points_per_coefficient * num_terms(points.shape[1], degree) >= len(points):
            break
        left, sizes, right = torch.linalg.svd(
            weight * monomials(points, degree), full_matrices=False
        )
        projected = left.mT @ wanted
        for penalty in penalties:
            inverse = sizes / (sizes.square() + penalty * len(points))
            kept = inverse * sizes
            leverage = (left.square() @ kept)[:, None].clamp(max=0.999)
            left_out = (wanted - left @ (kept[:, None] * projected)) / (1.0 - leverage)
            error = float((left_out.square() @ importance).mean())
            coefficients = right.mT @ (inverse[:, None] * projected)
            coefficients[0] += middle
            if error < least and bool(coefficients.isfinite().all()):
                least, found = error, Polynomial(coefficients, degree, error**0.5)
    return found


def num_terms(number: int, degree: int) -> int:
    """Returns the number of monomials of some variables up to a degree."""
    return math.comb(number + degree, degree)


def monomials(values: Tensor, degree: int) -> Tensor:
    """Returns all monomials of ``(n, k)`` variables up to a degree, ``(n, terms)``."""
    columns: list[Tensor] = []
    known: dict[tuple[int, ...], Tensor] = {(): torch.ones(len(values), dtype=torch.float64)}
    for chosen in _exponents(values.shape[1], degree):
        if chosen:
            known[chosen] = known[chosen[:-1]] * values[:, chosen[-1]]
        columns.append(known[chosen])
    return torch.stack(columns, dim=-1)


def _exponents(number: int, degree: int) -> list[tuple[int, ...]]:
    """Returns the variables whose product is each monomial, the constant first."""
    return [
        chosen
        for power in range(degree + 1)
        for chosen in combinations_with_replacement(range(number), power)
    ]
