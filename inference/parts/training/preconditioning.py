"""Preconditioning: the part solved in closed form before a density estimator is trained.

A density estimator of parameters z given features x should learn only the part that is neither
marginal nor linear. Features are mapped by their empirical quantiles to normal scores. Parameters
are replaced by their standardised residuals of a ridge regression on these scores,

    f_j = Phi^-1(F_j(x_j)),        u = L^-1 (z - A f - b),        L L^T = Cov[z - A f - b],

which is an affine map of z whose log determinant -sum(log diag L) is exact. For linear-Gaussian
problems u given f is N(0, I) and nothing is left to learn.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor

__all__ = [
    "Preconditioner",
    "fit_preconditioner",
    "normal_scores",
    "quantile_knots",
    "refit_regression",
    "residual_factor",
    "ridge_regression",
    "whiten_unseen",
]

MAX_KNOTS = 65
"""Number of knots of a quantile map: steps of about 0.12 standard deviations with 10 000
simulations."""

SIMULATIONS_PER_KNOT = 10
"""With fewer simulations there are fewer knots, so that the map does not follow sampling noise."""

RAW_LIMIT = 10.0
"""The elements of raw arrays are clipped at this number of robust standard deviations."""

RIDGES = tuple(10.0**k for k in range(-6, 3))
"""Penalties tried, as a fraction of the number of simulations; the least leave-one-out error
selects one."""

MIN_SCALE = 1e-5
"""Minimum standard deviation of a residual, relative to its parameter's. x may determine z
exactly, but a density in float32 cannot be narrower than the resolution of its argument."""


@dataclass(frozen=True)
class Preconditioner:
    """A fitted preconditioner; every field is a tensor and can be written to disk directly.

    Attributes:
        knots: Quantiles of each feature, ``(F, K)``; for raw arrays, centre and scale per element,
            ``(2,) + observation.shape``.
        scores: Normal scores of the knots, ``(K,)``; empty for raw arrays.
        gain: Regression matrix A, ``(d, F)``; zero for raw arrays.
        offset: Intercept b, ``(d,)``.
        factor: Cholesky factor L of the residual covariance, ``(d, d)``.
    """

    knots: Tensor
    scores: Tensor
    gain: Tensor
    offset: Tensor
    factor: Tensor

    def features(self, x: Tensor) -> Tensor:
        """Standardises features; those outside the range seen in training are clipped to it.

        Args:
            x: Features ``(n, F)``, or raw arrays ``(n,) + observation.shape``.

        Returns:
            Normal scores ``(n, F)``, or clipped standardised arrays of x's shape.
        """
        if not len(self.scores):
            return ((x - self.knots[0]) / self.knots[1]).clamp(-RAW_LIMIT, RAW_LIMIT)
        return normal_scores(x, self.knots, self.scores)

    def outside(self, x: Tensor) -> Tensor:
        """Returns which features of one observation :meth:`features` clips, shape of x."""
        if not len(self.scores):
            return ((x - self.knots[0]) / self.knots[1]).abs() > RAW_LIMIT
        return (x < self.knots[:, 0]) | (x > self.knots[:, -1])

    @property
    def varies(self) -> Tensor:
        """Whether each feature took more than one value, ``(F,)``."""
        return self.knots[:, -1] > self.knots[:, 0]

    def shift(self, f: Tensor) -> Tensor:
        """Returns the regression A f + b, ``(n, d)`` or ``(d,)``, at standardised features f."""
        if not len(self.scores):
            return self.offset.expand(len(f), -1)
        return f @ self.gain.T + self.offset

    def whiten(self, z: Tensor, f: Tensor) -> Tensor:
        """Maps parameters ``(n, d)`` to residuals u, ``(n, d)``, at standardised features f."""
        return self.spread(z - self.shift(f))

    def spread(self, z: Tensor) -> Tensor:
        """Returns L^-1 z, ``(n, d)``."""
        return torch.linalg.solve_triangular(self.factor, z.T, upper=False).T

    def unwhiten(self, u: Tensor, f: Tensor) -> Tensor:
        """Maps residuals u back to parameters z, both ``(n, d)``."""
        return u @ self.factor.T + self.shift(f)

    @property
    def log_det(self) -> Tensor:
        """Log determinant of du/dz, a scalar."""
        return -self.factor.diagonal().log().sum()

    def to(self, device: torch.device) -> Self:
        """Returns a copy on a device."""
        return type(self)(**{k: v.to(device) for k, v in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Returns the fields by name, contiguous for files."""
        return {field.name: getattr(self, field.name).contiguous() for field in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Self:
        """Rebuilds a preconditioner from :meth:`tensors`."""
        return cls(**{field.name: tensors[field.name] for field in fields(cls)})


def fit_preconditioner(z: Tensor, x: Tensor, is_raw: bool = False) -> Preconditioner:
    """Fits quantile maps and a ridge regression to simulations.

    Args:
        z: Parameters, ``(n, d)``.
        x: Features, ``(n, F)``, or raw arrays, ``(n,) + observation.shape``.
        is_raw: Whether x is the input of a trained network. Arrays are then only standardised,
            robustly, and z is standardised without regression.
    """
    if is_raw:
        knots, scores = _centre_and_scale(x), z.new_zeros(0)
        return Preconditioner(
            knots, scores, z.new_zeros(z.shape[1], 0), z.mean(0), residual_factor(z - z.mean(0), z)
        )
    knots, scores = quantile_knots(x)
    marginal = Preconditioner(
        knots,
        scores,
        z.new_zeros(z.shape[1], x.shape[1]),
        z.mean(0),
        torch.eye(z.shape[1], dtype=z.dtype, device=z.device),
    )
    gain, offset, residuals = ridge_regression(marginal.features(x), z)
    return Preconditioner(
        marginal.knots, marginal.scores, gain, offset, residual_factor(residuals, z)
    )


def quantile_knots(x: Tensor) -> tuple[Tensor, Tensor]:
    """Returns quantiles of every feature, ``(F, K)``, and their normal scores, ``(K,)``.

    Args:
        x: Features, ``(n, F)``.
    """
    num_knots = min(MAX_KNOTS, max(5, len(x) // SIMULATIONS_PER_KNOT))
    edge = -torch.special.ndtri(torch.tensor(0.5 / len(x), dtype=torch.float64)).item()
    scores = torch.linspace(-edge, edge, num_knots, dtype=torch.float64, device=x.device)
    levels = torch.special.ndtr(scores)
    levels[0], levels[-1] = 0.0, 1.0
    ordered = x.double().sort(dim=0).values
    position = levels * (len(x) - 1)
    low = position.floor().long().clamp(max=len(x) - 2)
    knots = torch.lerp(ordered[low], ordered[low + 1], (position - low)[:, None]).T
    return knots.to(x.dtype).contiguous(), scores.to(x.dtype)


def normal_scores(x: Tensor, knots: Tensor, scores: Tensor) -> Tensor:
    """Maps features through their quantiles to normal scores, both ``(n, F)``.

    Args:
        x: Features; those beyond the outer quantiles are clipped to them.
        knots: Quantiles, ``(F, K)``.
        scores: Their normal scores, ``(K,)``.
    """
    columns = x.T.contiguous()
    above = torch.searchsorted(knots, columns).clamp(1, len(scores) - 1)
    low, high = knots.gather(1, above - 1), knots.gather(1, above)
    weight = ((columns - low) / (high - low).clamp(min=torch.finfo(x.dtype).tiny)).clamp(0, 1)
    found = torch.lerp(scores[above - 1], scores[above], weight)
    # A feature that never varied has no information, whatever its value in the observation.
    return torch.where((knots[:, -1] > knots[:, 0])[:, None], found, 0.0).T.contiguous()


def refit_regression(preconditioner: Preconditioner, z: Tensor, x: Tensor) -> Preconditioner:
    """Repeats the regression of parameters on features with other simulations.

    Args:
        preconditioner: A preconditioner of features, not of raw arrays; its quantile maps stay.
        z: Parameters, ``(n, d)``.
        x: Features, ``(n, F)``.
    """
    gain, offset, residuals = ridge_regression(preconditioner.features(x), z)
    factor = residual_factor(residuals, z)
    return replace(preconditioner, gain=gain, offset=offset, factor=factor)


def whiten_unseen(preconditioner: Preconditioner, z: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Whitens the simulations of a preconditioner's fit as if each had been left out of the fit.

    A regression's residuals are too small at the simulations of its fit. The fewer simulations
    there are for each feature, the smaller they are. An estimator trained on them would be too
    narrow everywhere else, so the leave-one-out residuals are used.

    Args:
        preconditioner: Result of :func:`fit_preconditioner` for these simulations.
        z: Parameters, ``(n, d)``.
        x: Features, ``(n, F)``, or raw arrays.

    Returns:
        Whitened parameters ``(n, d)`` and standardised features of x's shape.
    """
    f = preconditioner.features(x)
    if not len(preconditioner.scores):
        return preconditioner.whiten(z, f), f
    _, _, residuals = ridge_regression(f.cpu(), z.cpu())
    return preconditioner.spread(residuals.to(z.device)), f


def _centre_and_scale(x: Tensor) -> Tensor:
    """Returns median and scaled interquartile range of every element, ``(2,) + x.shape[1:]``."""
    ordered = x.sort(dim=0).values
    n = len(x)
    low, centre, high = ordered[n // 4], ordered[n // 2], ordered[(3 * n) // 4]
    scale = (high - low) / 1.349
    # A mostly constant element has an interquartile range of zero, but may still vary.
    scale = torch.where(scale > 0, scale, x.std(0))
    return torch.stack((centre, torch.where(scale > 0, scale, 1.0)))


def ridge_regression(f: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Regresses z on f with the penalty of least leave-one-out error.

    With the eigendecomposition F^T F = V diag(s) V^T of the centred features, the leverages are
    h_i = sum_k (F V)_ik^2 / (s_k + lambda) + 1 / n and the leave-one-out residuals r_i / (1 - h_i)
    (Hastie, Tibshirani & Friedman 2009, Eq. 7.52).

    Returns:
        Gain ``(d, F)``, offset ``(d,)`` and leave-one-out residuals ``(n, d)``.
    """
    f64, z64 = f.double(), z.double()
    f_mean, z_mean = f64.mean(0), z64.mean(0)
    centred, target = f64 - f_mean, z64 - z_mean
    s, v = torch.linalg.eigh(centred.T @ centred)
    s = s.clamp(min=0)
    rotated = centred @ v
    projected = rotated.T @ target
    squares = rotated**2
    best: tuple[float, Tensor, Tensor] | None = None
    for ridge in RIDGES:
        shrink = 1 / (s + ridge * len(f))
        leverage = squares @ shrink + 1 / len(f)
        coefficients = shrink[:, None] * projected
        residuals = (target - rotated @ coefficients) / (1 - leverage).clamp(min=1e-9)[:, None]
        error = residuals.var(0).log().sum().item()
        if best is None or error < best[0]:
            best = error, v @ coefficients, residuals
    assert best is not None
    _, gain, residuals = best
    return (
        gain.T.to(z.dtype).contiguous(),
        (z_mean - f_mean @ gain).to(z.dtype),
        residuals.to(z.dtype),
    )


def residual_factor(residuals: Tensor, z: Tensor) -> Tensor:
    """Returns the Cholesky factor of the residuals' covariance with a floor, ``(d, d)``."""
    r, floor = residuals.double(), MIN_SCALE * z.double().std(0).clamp(min=MIN_SCALE)
    covariance = r.T @ r / len(r) + torch.diag(floor**2)
    scale = covariance.diagonal().sqrt()
    # Shrinkage towards the diagonal keeps the factor well conditioned with few simulations.
    weight = len(r) / (len(r) + z.shape[1])
    correlation = weight * covariance / scale[:, None] / scale
    correlation.fill_diagonal_(1.0)
    factor = scale[:, None] * torch.linalg.cholesky(correlation)
    # A fixed memory layout, so that a factor read from disk gives bitwise the same results.
    return factor.to(z.dtype).contiguous()
