"""Preconditioning of features given parameters, for backends that learn a likelihood.

Parameters are noise-free. The smooth dependence of x on them can therefore be removed by
regression,

    u = L^-1 (V^T s - m(z)),        L L^T = Cov[V^T s - m(z)],        s_j = Phi^-1(F_j(x_j)),

with a polynomial m in the parameters, scaled to [-1, 1], and combinations V of the features'
normal scores s. With scores, a few extreme simulations, such as a light pendulum that spins, do
not dominate the regression. A density of s is a density of x up to a function of x.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb

import torch
from torch import Tensor

from npdr_ppl.inference.parts.training.preconditioning import (
    Preconditioner,
    normal_scores,
    quantile_knots,
    residual_factor,
    ridge_regression,
)

__all__ = ["LikelihoodPreconditioner", "fit_likelihood_preconditioner"]

MAX_DEGREE = 12
"""Maximum degree of the polynomial."""

MAX_TERMS, SIMULATIONS_PER_TERM = 300, 20
"""Maximum number of terms of the polynomial. The time of the regression is proportional to their
square times the number of simulations. Fewer simulations determine fewer terms."""

MIN_SCATTER = 1e-5
"""Minimum scatter of a feature at given parameters, relative to its spread. A feature without
scatter would distinguish parameters infinitely well."""


@dataclass(frozen=True)
class LikelihoodPreconditioner(Preconditioner):
    """A fitted preconditioner of features given parameters.

    ``knots`` hold the parameters' mean and standard deviation, ``gain`` the coefficients of m.

    Attributes:
        degrees: Degrees of m's terms in each parameter, ``(M, d)``.
        edges: Minimum and maximum standardised value of each parameter, ``(2, d)``; beyond them
            the polynomial is constant.
        directions: Combinations V of the scores, ``(F, k)``; ``(F, 0)`` for all of them.
        feature_knots: Quantiles of each feature, ``(F, K)``. Features are clipped to the outer
            ones, because a density would extrapolate beyond them.
        feature_scores: Normal scores of the quantiles, ``(K,)``.
        is_bounded: Whether m and the density are functions of Phi(z) instead of z, a scalar.
    """

    degrees: Tensor
    edges: Tensor
    directions: Tensor
    feature_knots: Tensor
    feature_scores: Tensor
    is_bounded: Tensor

    def features(self, x: Tensor) -> Tensor:
        """Standardises parameters ``(n, d)``, or Phi of them."""
        return super().features(bounded(x) if bool(self.is_bounded) else x)

    def statistics(self, x: Tensor) -> Tensor:
        """Returns V^T s of features ``(n, F)``, ``(n, k)``."""
        s = normal_scores(x, self.feature_knots, self.feature_scores)
        return s @ self.directions if self.directions.shape[1] else s

    def shift(self, f: Tensor) -> Tensor:
        """Returns m, ``(n, k)``, at standardised parameters ``(n, d)``."""
        return polynomials(f, self.edges, self.degrees) @ self.gain.T + self.offset


def fit_likelihood_preconditioner(
    z: Tensor, x: Tensor, max_features: int, *, is_bounded: bool = False
) -> LikelihoodPreconditioner:
    """Fits polynomial, combinations and whitening to simulations.

    Args:
        z: Parameters, ``(n, d)``.
        x: Features, ``(n, F)``.
        max_features: Maximum number of combinations k.
        is_bounded: Whether m and the density are functions of Phi(z) instead of z.
    """
    limit = min(MAX_TERMS, max(z.shape[1], len(z) // SIMULATIONS_PER_TERM))
    candidates = [
        degrees_of(z.shape[1], degree)
        for degree in range(1, MAX_DEGREE + 1)
        if comb(z.shape[1] + degree, degree) - 1 <= limit or degree == 1
    ]
    values = bounded(z) if is_bounded else z
    knots = torch.stack((values.mean(0), values.std(0).clamp_min(1e-12)))
    f = (values - knots[0]) / knots[1]
    edges = torch.stack((f.amin(0), f.amax(0)))
    bases = [polynomials(f, edges, degrees) for degrees in candidates]
    feature_knots, feature_scores = quantile_knots(x)
    seen = normal_scores(x, feature_knots, feature_scores)
    directions = x.new_zeros(x.shape[1], 0)
    if x.shape[1] > max_features:
        directions = discriminants(seen, bases[-1], max_features)
        seen = seen @ directions
    best: tuple[float, Tensor, Tensor, Tensor, Tensor] | None = None
    for degrees, basis in zip(candidates, bases, strict=True):
        gain, offset, residuals = ridge_regression(basis, seen)
        error = residuals.double().var(0).clamp_min(1e-30).log().sum().item()
        if best is None or error < best[0]:
            best = error, degrees, gain, offset, residuals
    assert best is not None
    _, degrees, gain, offset, residuals = best
    return LikelihoodPreconditioner(
        knots=knots,
        scores=z.new_zeros(0),
        gain=gain,
        offset=offset,
        factor=residual_factor(residuals, seen),
        degrees=degrees,
        edges=edges,
        directions=directions,
        feature_knots=feature_knots,
        feature_scores=feature_scores,
        is_bounded=torch.tensor(is_bounded),
    )


def bounded(z: Tensor) -> Tensor:
    """Returns Phi(z) scaled to unit variance under a standard normal; linear in a uniform prior.

    A parameter with a uniform prior hardly changes where z is large. Its effect is therefore
    smooth in Phi(z) up to the prior's ends, but not in z.
    """
    return torch.special.ndtr(z) * 12.0**0.5


def degrees_of(num_parameters: int, degree: int) -> Tensor:
    """Returns the degrees of all terms of total degree 1 to ``degree``, ``(M, d)``."""
    rows = []
    for total in range(1, degree + 1):
        for chosen in combinations_with_replacement(range(num_parameters), total):
            rows.append([chosen.count(k) for k in range(num_parameters)])
    return torch.tensor(rows)


def polynomials(f: Tensor, edges: Tensor, degrees: Tensor) -> Tensor:
    """Returns products of Chebyshev polynomials, ``(n, M)``, which float32 evaluates well.

    Args:
        f: Standardised parameters, ``(n, d)``.
        edges: Values that are scaled to -1 and 1, ``(2, d)``; points beyond are clipped to them.
        degrees: Degrees of the terms, ``(M, d)``.
    """
    inside = f.clamp(edges[0], edges[1])
    t = 2 * (inside - edges[0]) / (edges[1] - edges[0]).clamp_min(1e-12) - 1
    chebyshev = [torch.ones_like(t), t]
    for _ in range(int(degrees.max()) - 1):
        chebyshev.append(2 * t * chebyshev[-1] - chebyshev[-2])
    table = torch.stack(chebyshev)  # (degree + 1, n, d)
    result = torch.ones(len(f), len(degrees), dtype=f.dtype, device=f.device)
    for k in range(f.shape[1]):
        result = result * table[degrees[:, k], :, k].T
    return result


def discriminants(x: Tensor, basis: Tensor, num_directions: int) -> Tensor:
    """Returns the combinations of features with the most information on the parameters.

    Features are regressed on functions of the parameters. With the covariance B of the fitted
    values and the covariance W of the residuals, the directions v maximise v^T B v / v^T W v one
    after another (Fisher 1936; Rao 1948).

    Args:
        x: Features, ``(n, F)``.
        basis: Functions of the parameters, ``(n, M)``.
        num_directions: Number k of directions.

    Returns:
        Directions ``(F, k)``, scaled so that residuals have unit variance.
    """
    scale = x.std(0).double()
    varies = scale > 0
    scale = torch.where(varies, scale, 1.0)
    standard = (x.double() - x.double().mean(0)) / scale
    centred = basis.double() - basis.double().mean(0)
    gram = centred.T @ centred
    gram += torch.diag(1e-9 * gram.diagonal().clamp_min(1e-12))
    fitted = centred @ torch.linalg.solve(gram, centred.T @ standard)
    residual = standard - fitted
    within = residual.T @ residual / len(x) + torch.diag(MIN_SCATTER + (~varies).double())
    factor = torch.linalg.cholesky(within)
    between = torch.linalg.solve_triangular(factor, fitted.T @ fitted / len(x), upper=False)
    between = torch.linalg.solve_triangular(factor, between.T, upper=False)
    _, vectors = torch.linalg.eigh(between)
    leading = vectors.flip(1)[:, :num_directions]
    directions = torch.linalg.solve_triangular(factor.T, leading, upper=True)
    return (directions * (varies / scale)[:, None]).to(x.dtype).contiguous()
