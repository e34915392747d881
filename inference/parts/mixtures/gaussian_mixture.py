"""Mixtures of Gaussians as densities in reference coordinates."""

import math

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density

__all__ = ["GaussianMixture", "triangular_factors"]


ROUNDING = 1e-12
"""Error of a sum of normalised weights in float64."""


class GaussianMixture(Density):
    """The mixture q(z) = sum_k w_k N(z; m_k, (T_k^T T_k)^-1).

    Computes in float64. There the triangular factors of very narrow components remain accurate,
    whereas covariance matrices would not.

    Args:
        log_weights: Logarithms of the weights w_k up to a common constant, ``(K,)``.
        means: Means m_k, ``(K, d)``.
        precision_factors: Upper triangular factors T_k of the precisions, with positive
            diagonals, ``(K, d, d)``.
    """

    def __init__(self, log_weights: Tensor, means: Tensor, precision_factors: Tensor) -> None:
        log_weights = log_weights.double()
        total = log_weights.logsumexp(0)
        # Normalised weights stay bitwise the same: a mixture read from a file equals the one that
        # was written.
        self.log_weights = log_weights - torch.where(total.abs() < ROUNDING, 0.0, total)
        self.means = means.double()
        self.precision_factors = precision_factors.double()

    @classmethod
    def from_moments(
        cls, weights: Tensor, means: Tensor, covariances: Tensor
    ) -> "GaussianMixture":
        """Makes a mixture of weights ``(K,)``, means ``(K, d)`` and covariances ``(K, d, d)``."""
        inverses = torch.linalg.cholesky(covariances.double())
        eye = torch.eye(means.shape[1], dtype=torch.float64, device=means.device)
        roots = torch.linalg.solve_triangular(inverses, eye, upper=False)
        return cls(weights.double().log(), means, triangular_factors(roots))

    @property
    def weights(self) -> Tensor:
        """Weights w_k, ``(K,)``."""
        return self.log_weights.exp()

    @property
    def covariances(self) -> Tensor:
        """Covariances of the components, ``(K, d, d)``."""
        eye = torch.eye(self.means.shape[1], dtype=torch.float64, device=self.means.device)
        roots = torch.linalg.solve_triangular(self.precision_factors, eye, upper=True)
        return roots @ roots.mT

    def moments(self) -> tuple[Tensor, Tensor]:
        """Returns mean ``(d,)`` and covariance ``(d, d)`` of the mixture."""
        mean = self.weights @ self.means
        away = self.means - mean
        spread = torch.einsum("k,ki,kj->ij", self.weights, away, away)
        return mean, torch.einsum("k,kij->ij", self.weights, self.covariances) + spread

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` from torch's global stream, in float32 on the CPU."""
        d = self.means.shape[1]
        component = torch.multinomial(self.weights.cpu(), num_samples, replacement=True)
        noise = torch.randn(num_samples, d, dtype=torch.float64)
        z = torch.empty(num_samples, d, dtype=torch.float64)
        factors, means = self.precision_factors.cpu(), self.means.cpu()
        for k in range(len(means)):
            rows = component == k
            scaled = torch.linalg.solve_triangular(factors[k], noise[rows].T, upper=True)
            z[rows] = means[k] + scaled.T
        return z.to(torch.float32)

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``; differentiable in z."""
        d = self.means.shape[1]
        away = z.to(self.means) - self.means[:, None]
        white = away @ self.precision_factors.mT
        log_det = self.precision_factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        log_scale = self.log_weights + log_det - 0.5 * d * math.log(2 * math.pi)
        log_normal = log_scale[:, None] - 0.5 * white.square().sum(-1)
        return log_normal.logsumexp(0).to(z)


def triangular_factors(roots: Tensor) -> Tensor:
    """Returns upper triangular T with T^T T = W^T W and positive diagonal.

    It uses orthogonal triangularisation, which cannot fail, unlike a Cholesky factorisation of W^T
    W.

    Args:
        roots: Square roots W of precisions, ``(..., d, d)``.
    """
    upper = torch.linalg.qr(roots, mode="r").R
    return upper * upper.diagonal(dim1=-2, dim2=-1).sign()[..., None]
