"""Weighted draws of a posterior, and how much their weights can be trusted."""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.preparation.ridges import RidgeCoordinates
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING

__all__ = ["WeightedDraws", "effective_size", "smoothed_weights"]


@dataclass(frozen=True)
class WeightedDraws:
    """Weighted draws of a posterior.

    Attributes:
        z: Reference coordinates, ``(n, d)``.
        w: The same in coordinates in which ridges are straight, ``(n, d)``.
        space: These coordinates.
        log_weights: Logarithms of their weights, whose sum is one, ``(n,)``.
        k_hat: Shape of the tail of the weights; reliable up to ``IMPORTANCE_SAMPLING.reliable_k``.
        effective: Effective sample size of the weights.
        iterations: Number of proposals, or of fits of polynomials, that were needed.
    """

    z: Tensor
    w: Tensor
    space: RidgeCoordinates
    log_weights: Tensor
    k_hat: float
    effective: float
    iterations: int

    @classmethod
    def of(
        cls, w: Tensor, space: RidgeCoordinates, log_weights: Tensor, k_hat: float, iterations: int
    ) -> "WeightedDraws":
        """Returns draws in coordinates in which ridges are straight; see the attributes."""
        z, size = space.to_reference(w)[0], effective_size(log_weights)
        return cls(z, w, space, log_weights, k_hat, size, iterations)

    @property
    def weights(self) -> Tensor:
        """The weights, ``(n,)``."""
        return self.log_weights.exp()

    @property
    def is_reliable(self) -> bool:
        """Whether the draws represent the posterior."""
        return (
            self.k_hat <= IMPORTANCE_SAMPLING.reliable_k
            and self.effective >= IMPORTANCE_SAMPLING.least_effective
        )

    @property
    def has_enough(self) -> bool:
        """Whether no more draws are needed."""
        return (
            self.k_hat <= IMPORTANCE_SAMPLING.reliable_k
            and self.effective >= IMPORTANCE_SAMPLING.enough_effective
        )

    def moments(self) -> tuple[Tensor, Tensor]:
        """Returns mean ``(d,)`` and covariance ``(d, d)``."""
        mean = self.weights @ self.z
        away = self.z - mean
        return mean, (self.weights[:, None] * away).mT @ away


def smoothed_weights(log_weights: Tensor) -> tuple[Tensor, float]:
    """Returns Pareto-smoothed log weights, normalised, ``(n,)``, and the shape of their tail.

    If too few draws have a positive weight, all weights are set equal and the shape is infinite.
    """
    from npdr_ppl.arviz_module import pareto_smoothed

    smoothed, k_hat = pareto_smoothed(log_weights.numpy())
    result = torch.from_numpy(smoothed)
    if not bool(result.isfinite().any()):
        result = torch.zeros(len(log_weights), dtype=torch.float64)
    return result - result.logsumexp(0), k_hat


def effective_size(log_weights: Tensor) -> float:
    """Returns the effective sample size of log weights that sum to one."""
    return float((-(2 * log_weights).logsumexp(0)).exp())
