"""Fourier features of stationary kernels (Rahimi & Recht 2007)."""

import math

import torch
from scipy.stats import chi2
from torch import Tensor, nn
from torch.quasirandom import SobolEngine

__all__ = ["KERNELS", "FourierFeatures", "median_distance"]

KERNELS = {"rbf": math.inf, "matern-3/2": 1.5, "matern-5/2": 2.5}
"""Smoothness nu of the kernels by name."""

NUM_DISTANCES = 10_000
"""Number of pairs of rows from which the median distance is computed."""


class FourierFeatures(nn.Module):
    """Features whose inner products approximate a kernel of unit bandwidth.

        k(f, f') ~ h(f)^T h(f'),      h(f) = (cos w_i^T f, sin w_i^T f)_i=1..m / sqrt(m).

    The spectral density of the Gaussian kernel exp(-|r|^2 / 2) is N(0, I), that of a Matern
    kernel Student's t with 2 nu degrees of freedom. Its draws are a scrambled Sobol sequence (Yang
    et al. 2014, *Quasi-Monte Carlo feature maps for shift-invariant kernels*), seeded from torch's
    global stream.

    Args:
        num_features: Length F of f.
        num_frequencies: Number m of frequencies.
        kernel: One of :data:`KERNELS`.

    Attributes:
        frequencies: Frequencies w_i, ``(m, F)``; divided by s they are those of bandwidth s.
    """

    frequencies: Tensor

    def __init__(self, num_features: int, num_frequencies: int, kernel: str) -> None:
        super().__init__()
        seed = int(torch.randint(2**31, ()))
        engine = SobolEngine(num_features + 1, scramble=True, seed=seed)
        # The middle of a cell of the sequence's resolution is never zero or one.
        uniform = engine.draw(num_frequencies, dtype=torch.float64).clamp(2**-31, 1 - 2**-31)
        frequencies = torch.special.ndtri(uniform[:, 1:])
        nu = KERNELS[kernel]
        if math.isfinite(nu):
            draws = torch.from_numpy(chi2.ppf(uniform[:, 0].numpy(), 2 * nu))
            frequencies = frequencies / (draws[:, None] / (2 * nu)).sqrt()
        self.register_buffer("frequencies", frequencies.to(torch.float32))

    def forward(self, f: Tensor) -> Tensor:
        """Returns features ``(n, 2 m)`` of rows ``(n, F)``."""
        phase = f @ self.frequencies.mT
        return torch.cat((phase.cos(), phase.sin()), -1) / math.sqrt(len(self.frequencies))


def median_distance(f: Tensor) -> float:
    """Returns the median distance between two rows of ``(n, F)``, drawn from the global stream.

    It is one if most rows are equal.
    """
    first, second = torch.randint(len(f), (2, NUM_DISTANCES))
    distance = (f[first] - f[second])[first != second].norm(dim=-1).median().item()
    return distance if distance > 0 else 1.0
