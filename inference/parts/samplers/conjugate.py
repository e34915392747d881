r"""Bayesian linear regression with the conjugate normal–inverse-gamma prior.

    t | β, σ² ~ N(A β, σ² I),    β | σ² ~ N(m₀, σ² V₀),    p(σ²) ∝ σ⁻².

Then β | t is a multivariate Student-t with N degrees of freedom about m_n with scale matrix
(b_n/a_n) Λ_n⁻¹, where Λ_n = V₀⁻¹ + AᵀA, m_n = Λ_n⁻¹ (V₀⁻¹ m₀ + Aᵀt), a_n = N/2 and
2 b_n = ‖t − A m_n‖² + (m_n − m₀)ᵀ V₀⁻¹ (m_n − m₀). With known noise the prior is β ~ N(m₀, V₀),
and the posterior is normal.

Reference: C. M. Bishop, Pattern Recognition and Machine Learning, 2006, §3.3 and exercise 3.12;
A. Gelman et al., Bayesian Data Analysis, 3rd ed., 2013, §14.8.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError, ShapeError

__all__ = ["StudentT", "linear_posterior", "row_noise"]

REWEIGHTINGS = 10
"""Number of iterations between the fit and the noise of each kind of row."""

RELATIVE_NOISE = 1e-9
"""Minimum noise of a kind of row, relative to the size of its terms."""


@dataclass(frozen=True)
class StudentT:
    """A multivariate Student-t distribution; normal where the degrees of freedom are infinite.

    Attributes:
        mean: Location, ``(k,)``.
        factor: Lower triangular factor of the scale matrix, ``(k, k)``.
        degrees: Degrees of freedom, a scalar.
    """

    mean: Tensor
    factor: Tensor
    degrees: Tensor

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, k)`` from torch's global stream."""
        normal = torch.randn(num_samples, len(self.mean), dtype=self.mean.dtype)
        if not math.isinf(float(self.degrees)):
            chi_square = torch.distributions.Chi2(self.degrees).sample((num_samples,))
            normal = normal * (self.degrees / chi_square).sqrt()[:, None]
        return self.mean + normal @ self.factor.T

    def log_prob(self, value: Tensor) -> Tensor:
        """Returns the log density at ``(n, k)``, shape ``(n,)``."""
        k = len(self.mean)
        scaled = torch.linalg.solve_triangular(self.factor, (value - self.mean).T, upper=False)
        square = scaled.square().sum(0)
        log_det = self.factor.diagonal().log().sum()
        if math.isinf(float(self.degrees)):
            return -0.5 * (square + k * math.log(2.0 * math.pi)) - log_det
        v = self.degrees
        constant = torch.lgamma(0.5 * (v + k)) - torch.lgamma(0.5 * v)
        constant = constant - 0.5 * k * (v * math.pi).log() - log_det
        return constant - 0.5 * (v + k) * torch.log1p(square / v)

    def standard_deviations(self) -> Tensor:
        """Returns the standard deviation of each component, ``(k,)``; infinite up to 2 degrees."""
        scale = self.factor.square().sum(-1).sqrt()
        if math.isinf(float(self.degrees)):
            return scale
        spread = self.degrees / (self.degrees - 2.0)
        return scale * torch.where(spread > 0.0, spread, torch.inf).sqrt()

    def tensors(self) -> dict[str, Tensor]:
        """Returns the fields by name."""
        return {"mean": self.mean, "factor": self.factor, "degrees": self.degrees}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "StudentT":
        """Rebuilds a distribution from :meth:`tensors`."""
        return cls(tensors["mean"], tensors["factor"], tensors["degrees"])


def linear_posterior(
    regressors: Tensor,
    targets: Tensor,
    prior_mean: Tensor,
    prior_covariance: Tensor,
    noise: float | None = None,
) -> StudentT:
    """Returns the posterior of β; see the module's text.

    Args:
        regressors: A, ``(N, k)``, float64.
        targets: t, ``(N,)``.
        prior_mean: m₀, ``(k,)``.
        prior_covariance: V₀, ``(k, k)``, positive definite.
        noise: σ if it is known.

    Raises:
        ShapeError: The shapes do not fit each other.
        BackendError: Something is not finite, or V₀ is not positive definite.
    """
    k = len(prior_mean)
    if regressors.shape != (len(targets), k) or prior_covariance.shape != (k, k):
        raise ShapeError(
            f"The regression needs A (N, k), t (N,), m0 (k,) and V0 (k, k), got "
            f"{tuple(regressors.shape)}, {tuple(targets.shape)}, {tuple(prior_mean.shape)} and "
            f"{tuple(prior_covariance.shape)}."
        )
    if not all(x.isfinite().all() for x in (regressors, targets, prior_mean, prior_covariance)):
        raise BackendError("The regression's matrices contain NaN or infinity.")
    # In units of the prior, β = m₀ + S u with u ~ N(0, σ² I), so that scales have no effect.
    scale, info = torch.linalg.cholesky_ex(prior_covariance)
    if int(info):
        raise BackendError("The prior covariance of the base parameters is not positive definite.")
    sigma = 1.0 if noise is None else noise
    rows = regressors @ scale / sigma
    rest = (targets - regressors @ prior_mean) / sigma
    # Least squares of the prior's rows and the data's; QR does not square the condition number.
    stacked = torch.cat((rows, torch.eye(k, dtype=rows.dtype)))
    q, r = torch.linalg.qr(stacked)
    u = torch.linalg.solve_triangular(
        r, (q.T @ torch.cat((rest, rest.new_zeros(k))))[:, None], upper=True
    )[:, 0]
    root = torch.linalg.solve_triangular(r, torch.eye(k, dtype=r.dtype), upper=True)
    if noise is not None:
        degrees, variance = torch.tensor(torch.inf, dtype=r.dtype), r.new_ones(())
    else:
        degrees = torch.tensor(float(len(targets)), dtype=r.dtype)
        square = (rest - rows @ u).square().sum() + u.square().sum()
        # Without any residual the density would have zero width.
        floor = torch.finfo(r.dtype).eps ** 2 * rest.square().sum().clamp_min(1e-300)
        variance = torch.maximum(square, floor) / degrees
    # Any square root of the scale matrix; the lower triangular one comes from its QR.
    factor = torch.linalg.qr((scale @ root).T)[1].T
    factor = factor * factor.diagonal().sign() * variance.sqrt()
    return StudentT(prior_mean + scale @ u, factor.contiguous(), degrees)


def row_noise(
    rows: Tensor, targets: Tensor, prior_mean: Tensor, prior_covariance: Tensor
) -> Tensor:
    """Returns the noise of rows of J kinds, ``(J,)``, by iteratively reweighted fits.

    Rows of one joint have the same unit and noise; joints differ. The noise of a kind is the
    residual in units of the kind's largest term under the fit, times that term under the prior's
    mean. This scaling is needed where the right-hand side is zero. Without it the residual would
    vanish as β goes to zero, and growing weights would drive β to zero.

    Args:
        rows: Regressors, ``(N, J, k)``.
        targets: Right-hand side, ``(N, J)``.
        prior_mean: Mean of β under the prior, ``(k,)``.
        prior_covariance: Its covariance, ``(k, k)``.
    """

    def size(beta: Tensor) -> Tensor:
        terms = (rows.square().mean(0) * beta.square()).amax(-1)
        return torch.maximum(terms, targets.square().mean(0)).sqrt()

    expected = size(prior_mean)
    expected = torch.where(expected > 0.0, expected, 1.0)
    noise = expected
    for _ in range(REWEIGHTINGS):
        fit = linear_posterior(
            (rows / noise[:, None]).flatten(0, 1),
            (targets / noise).flatten(),
            prior_mean,
            prior_covariance,
        )
        found = size(fit.mean)
        left = (targets - rows @ fit.mean).square().mean(0).sqrt()
        share = torch.where(found > 0.0, left / found, 1.0)
        noise = expected * share.clamp_min(RELATIVE_NOISE)
    return noise
