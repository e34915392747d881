"""A problem whose parameters enter linearly, after a change of variables."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

__all__ = ["LinearRegression"]


@dataclass(frozen=True)
class LinearRegression:
    """A β = t + noise, and how β follows from reference coordinates z.

    Everything is float64. Some coordinates may be *free*: β does not determine them, but they may
    be needed to compute the others. For example, a motor's constants are needed to convert volts
    into masses.

    Attributes:
        regressors: Matrix A, ``(N, k)``, its rows scaled so that all have the same noise.
        targets: Right-hand side t, ``(N,)``.
        names: Names of the base parameters β, k of them.
        prior_mean: Mean of β under the prior, ``(k,)``.
        prior_covariance: Its covariance, ``(k, k)``. If the noise is inferred, it is the
            covariance at σ = 1, and the rows should be scaled to σ = 1.
        determined: Mask of the k coordinates of z that β determines, ``(d,)``.
        nominal: Reference coordinates of the nominal parameters, ``(d,)``; NaN where they lie
            outside the prior's support.
        to_reference: Maps β, ``(n, k)``, and points z, ``(n, d)``, to points with that β and the
            same free coordinates. Also returns a mask ``(n,)`` of the plausible points; the other
            rows hold arbitrary finite values.
        from_reference: Maps z, ``(n, d)``, to β, ``(n, k)``.
        noise: Standard deviation of the noise where it is known, ``None`` to infer it.
    """

    regressors: Tensor
    targets: Tensor
    names: tuple[str, ...]
    prior_mean: Tensor
    prior_covariance: Tensor
    determined: Tensor
    nominal: Tensor
    to_reference: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    from_reference: Callable[[Tensor], Tensor]
    noise: float | None = None
