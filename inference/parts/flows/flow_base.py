"""The base density of a trained flow, widened according to held-out simulations.

A flow T is trained with a standard normal base. It fits the simulations of its training better
than others, so its posteriors are too narrow. Two numbers, common to an ensemble's members,
correct this: a scale s and the degrees of freedom nu of a multivariate t distribution,

    q_m(u | f) = t_nu(T_m(u; f) / s) s^-d |det dT_m / du|,

whose limit nu to infinity is a normal distribution. They maximise the likelihood of the members'
mixture at simulations on which no member was trained. So few parameters cannot overfit. If the
flows are right, they stay at one and infinity.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError

__all__ = ["CHUNK", "FlowBase", "finite_samples", "fit_base"]

CHUNK = 4_096
"""Rows sampled or evaluated in one batch. With many more, intermediate values do not fit into the
cache, which takes three times as long as the arithmetic."""

MAX_REDRAWS = 100
"""Maximum number of attempts to replace samples that are not finite; then an error is raised."""

SCALES = tuple(math.exp(0.02 * k) for k in range(-15, 41))
"""Scales tried, in steps of 2 %."""

FREEDOMS = (math.inf, 100.0, 50.0, 30.0, 20.0, 15.0, 10.0, 7.0, 5.0, 4.0, 3.0)
"""Degrees of freedom tried."""

MIN_GAIN = 1.0
"""Minimum gain in total log likelihood of the held-out rows over the standard normal, for each of
the two parameters (Akaike 1974). A smaller gain may be chance."""


@dataclass(frozen=True)
class FlowBase:
    """A multivariate t distribution around zero.

    Attributes:
        scale: Scale s.
        freedom: Degrees of freedom nu; infinity makes it a normal distribution.
    """

    scale: float = 1.0
    freedom: float = math.inf

    def sample(self, num_samples: int, d: int) -> Tensor:
        """Draws ``(num_samples, d)`` on the CPU from torch's global stream."""
        draws = torch.randn(num_samples, d) * self.scale
        if math.isinf(self.freedom):
            return draws
        square = torch.distributions.Chi2(torch.tensor(self.freedom)).sample((num_samples, 1))
        return draws * (self.freedom / square).sqrt()

    def log_prob(self, square: Tensor, d: int) -> Tensor:
        """Returns the log density given the squared distance from zero, of its shape.

        Args:
            square: Squared distances from zero.
            d: Dimension.
        """
        square, nu = square / self.scale**2, self.freedom
        if math.isinf(nu):
            return -0.5 * square - d * (0.5 * math.log(2 * math.pi) + math.log(self.scale))
        constant = math.lgamma(0.5 * (nu + d)) - math.lgamma(0.5 * nu)
        constant -= d * (0.5 * math.log(math.pi * nu) + math.log(self.scale))
        return constant - 0.5 * (nu + d) * (square / nu).log1p()


def fit_base(square: Tensor, log_det: Tensor, d: int) -> FlowBase:
    """Fits the base of an ensemble's members to held-out rows.

    Args:
        square: Squared distances from zero of the rows' images |T_m(u_n)|^2, ``(members, n)``.
        log_det: Log determinants of dT_m / du there, ``(members, n)``.
        d: Dimension of u.
    """
    square, log_det = square.double().cpu(), log_det.double().cpu()

    def log_likelihood(base: FlowBase) -> float:
        return float((base.log_prob(square, d) + log_det).logsumexp(0).sum())

    best = FlowBase()
    best_value = log_likelihood(best)
    for freedom in FREEDOMS:
        tried = [FlowBase(scale, freedom) for scale in SCALES]
        values = [log_likelihood(base) for base in tried]
        value = max(values)
        if value > best_value + MIN_GAIN:
            best, best_value = tried[values.index(value)], value
    return best


def finite_samples(draw: Callable[[int], Tensor], num_samples: int, d: int) -> Tensor:
    """Draws finite samples ``(num_samples, d)`` in batches; they are returned on the CPU.

    Args:
        draw: Returns n samples, ``(n, d)``; those that are not finite are replaced.
        num_samples: Number of samples.
        d: Dimension.

    Raises:
        BackendError: Too many samples are not finite.
    """
    chunks: list[Tensor] = []
    drawn, redraws = 0, 0
    while drawn < num_samples:
        n = min(CHUNK, num_samples - drawn)
        with torch.no_grad():
            z = draw(n)
        z = z[z.isfinite().all(-1)]
        redraws += len(z) < n
        if redraws > MAX_REDRAWS:
            raise BackendError("The flow keeps returning samples that are not finite.")
        chunks.append(z.cpu())
        drawn += len(z)
    return torch.cat(chunks) if chunks else torch.empty(0, d)
