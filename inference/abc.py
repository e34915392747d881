"""ABC: rejection with a local-linear regression adjustment, the baseline for all other methods.

The simulations nearest to the observation are kept. A linear regression on the features predicts
how their parameters would change at the observation, and they are moved accordingly (Beaumont,
Zhang & Balding 2002, *Approximate Bayesian computation in population genetics*, Eqs. 3-5). With
the distance rho_i of a simulation and the largest accepted one, delta,

    w_i = 1 - (rho_i / delta)^2,        z_i* = z_i - A (f_i - f_o),

where A minimises sum_i w_i ||z_i - a - A (f_i - f_o)||^2. The posterior is a mixture of Gaussian
kernels. Their centres are the z_i* moved towards their mean, so that the mixture has the mean and
covariance of the z_i* instead of a wider covariance (Liu & West 2001, *Combined parameter and
state estimation in simulation-based filtering*),

    q(z) = sum_i w_i N(z; c z_i* + (1 - c) mean, h^2 Cov[z*]),        c^2 + h^2 = 1.

In every round the parameters come from the prior; a later round only adds simulations. No
importance weights are needed, so none can degenerate, and the accepted simulations get nearer.

Distances are Euclidean in the normal scores of the features
(:mod:`npdr_ppl.inference.parts.training.preconditioning`). This scale is as robust as the median
absolute deviation, and bounded.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend, Density, Problem, Progress, State
from npdr_ppl.inference.parts.training.preconditioning import Preconditioner, fit_preconditioner

__all__ = ["ABC", "ABCState", "KernelDensity"]

RIDGE = 1e-3
"""Penalty of the regression on features of unit variance, relative to the sum of the weights."""

JITTER = 1e-6
"""Added to the correlation of the adjusted parameters, because they may coincide."""

FRACTIONS = (0.05, 0.1, 0.2, 0.35, 0.6, 1.0)
"""Bandwidths tried, as fractions of Silverman's."""

MAX_LEFT_OUT = 500
"""Maximum number of points left out, one at a time, to choose the bandwidth."""

CHUNK = 1024
"""Points whose density is evaluated in one batch. It bounds the memory, because each point has a
term for every accepted simulation."""


@dataclass(frozen=True)
class ABCState(State):
    """The data that the next round needs.

    Attributes:
        z: Parameters of all successful simulations, ``(n, d)``.
        x: Their features, ``(n, F)``.
    """

    z: Tensor
    x: Tensor


@dataclass(frozen=True)
class ABC(Backend[ABCState]):
    """Rejection ABC; see the module's text for the method.

    Args:
        accept: Fraction of the simulations that is accepted.
        min_accepted: Minimum number of accepted simulations; all are accepted if there are fewer.
        is_adjusted: Whether the accepted parameters are adjusted by regression.
    """

    name: ClassVar[str] = "abc"
    summary: ClassVar[str] = "rejection ABC with local-linear regression adjustment"
    amortises: ClassVar[bool] = True
    state_class = ABCState
    min_simulations: ClassVar[int] = 10  # fewer do not determine a covariance

    accept: float = 0.1
    min_accepted: int = 1000
    is_adjusted: bool = True

    def __post_init__(self) -> None:
        """Validates the options.

        Raises:
            BackendError: One is out of range.
        """
        if not 0 < self.accept <= 1:
            raise BackendError(f"{self.name}: accept must lie in (0, 1]; got {self.accept}.")
        self._check_at_least(2, "min_accepted")

    def init(self, problem: Problem) -> ABCState:
        """Returns the state before any simulation.

        Raises:
            BackendError: The problem needs a network trained on raw arrays.
        """
        if problem.build_network is not None:
            raise BackendError(
                f"{self.name} trains no network; choose an embedding with fixed features."
            )
        return ABCState(
            0, torch.empty(0, problem.num_parameters), torch.empty(0, *problem.observation.shape)
        )

    def learn(
        self, problem: Problem, state: ABCState, z: Tensor, x: Tensor, progress: Progress
    ) -> tuple[ABCState, dict[str, Any]]:
        """Adds a round of simulations; see :meth:`Backend.learn`."""
        state = replace(state, z=torch.cat((state.z, z)), x=torch.cat((state.x, x)))
        preconditioner = fit_preconditioner(state.z, state.x)
        rows, distance = self._nearest(problem, state, preconditioner)
        figures = {
            "accepted": len(rows),
            "largest_distance": distance.max().item(),
            "clipped_features": int(preconditioner.outside(problem.observation.cpu()).sum()),
        }
        progress(1.0, f"accepted {len(rows)} of {len(state.z)} simulations")
        return state, figures

    def densities(self, problem: Problem, state: State) -> list[Density]:
        """Returns the one posterior."""
        state = self._told(state)
        preconditioner = fit_preconditioner(state.z, state.x)
        rows, distance = self._nearest(problem, state, preconditioner)
        weight = 1 - (distance / distance.max().clamp(min=torch.finfo().tiny)) ** 2
        # If all distances are equal, e.g. with constant features, all weights are equal.
        weight = weight if weight.sum() > 0 else torch.ones_like(weight)
        z = state.z[rows].double()
        if self.is_adjusted:
            f = preconditioner.features(state.x[rows])
            offset = f - preconditioner.features(problem.observation.cpu().float()[None])
            z = _adjust(z, offset.double(), weight.double())
        return [KernelDensity(z, weight.double())]

    def _nearest(
        self, problem: Problem, state: ABCState, preconditioner: Preconditioner
    ) -> tuple[Tensor, Tensor]:
        """Returns the indices of the accepted simulations and their distances, both ``(k,)``."""
        observed = preconditioner.features(problem.observation.cpu().float()[None])
        distance = (preconditioner.features(state.x) - observed).norm(dim=-1)
        count = max(round(self.accept * len(distance)), self.min_accepted)
        nearest = distance.topk(min(count, len(distance)), largest=False)
        return nearest.indices, nearest.values


def _adjust(z: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """Adjusts parameters to the observation by a weighted ridge regression.

    Args:
        z: Accepted parameters, ``(k, d)``.
        offset: Their features minus the observation's, ``(k, F)``.
        weight: Weights w, ``(k,)``.
    """
    share = (weight / weight.sum())[:, None]
    f, target = offset - (share * offset).sum(0), z - (share * z).sum(0)
    scale = (share * f**2).sum(0).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    f = f / scale
    gram = f.T @ (share * f) + RIDGE * torch.eye(f.shape[1], dtype=f.dtype)
    gain = torch.linalg.solve(gram, f.T @ (share * target))
    return z - offset / scale @ gain


def _likeliest_width(points: Tensor, share: Tensor, widths: Sequence[float]) -> float:
    """Returns the bandwidth with the greatest leave-one-out log likelihood.

    Args:
        points: Points with mean zero and unit covariance, ``(k, d)``.
        share: Their weights, ``(k,)``, with sum 1.
        widths: Bandwidths to choose from.
    """
    some = torch.arange(0, len(points), max(1, len(points) // MAX_LEFT_OUT))
    log_share = share.log().expand(len(some), -1).clone()
    log_share[torch.arange(len(some)), some] = -torch.inf
    scores = []
    for width in widths:
        shrunk = math.sqrt(1 - width**2) * points
        square = (points[some, None] - shrunk).square().sum(-1) / width**2
        log_density = (log_share - 0.5 * square).logsumexp(-1) - points.shape[1] * math.log(width)
        scores.append(float((share[some] * log_density).sum()))
    return widths[max(range(len(widths)), key=scores.__getitem__)]


class KernelDensity(Density):
    """A mixture of Gaussian kernels with the mean and covariance of the points.

    The bandwidth h is a fraction of Silverman's (1986, Eq. 4.14) for the effective number of
    points. Silverman's bandwidth is meant for a single Gaussian and blurs modes and ridges. The
    fraction is therefore the one with the greatest leave-one-out likelihood.

    Args:
        points: Points z*, ``(k, d)``, in float64.
        weight: Their weights, ``(k,)``, up to a factor.
    """

    def __init__(self, points: Tensor, weight: Tensor) -> None:
        share = weight / weight.sum()
        d = points.shape[1]
        mean = (share[:, None] * points).sum(0)
        centred = points - mean
        covariance = centred.T @ (share[:, None] * centred)
        scale = covariance.diagonal().sqrt()
        scale = torch.where(scale > 0, scale, JITTER)
        correlation = covariance / scale[:, None] / scale
        correlation = correlation + JITTER * torch.eye(d, dtype=points.dtype)
        self._factor = scale[:, None] * torch.linalg.cholesky(correlation)
        effective = float(1 / (share**2).sum())
        silverman = min(1.0, (4 / ((d + 2) * effective)) ** (1 / (d + 4)))
        self._share = share
        self._width = _likeliest_width(
            torch.linalg.solve_triangular(self._factor, centred.T, upper=False).T,
            share,
            [fraction * silverman for fraction in FRACTIONS],
        )
        self._centres = mean + math.sqrt(1 - self._width**2) * centred

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` from torch's global stream."""
        chosen = torch.multinomial(self._share, num_samples, replacement=True)
        noise = torch.randn(num_samples, len(self._factor), dtype=self._factor.dtype)
        return (self._centres[chosen] + self._width * noise @ self._factor.T).float()

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``; differentiable in z."""
        factor = self._width * self._factor

        def whiten(points: Tensor) -> Tensor:
            return torch.linalg.solve_triangular(factor, points.T, upper=False).T

        centres, log_share = whiten(self._centres), self._share.log()
        constant = factor.diagonal().log().sum() + 0.5 * len(factor) * math.log(2 * math.pi)
        values = [
            (log_share - 0.5 * (u[:, None] - centres).square().sum(-1)).logsumexp(-1)
            for u in whiten(z.cpu().double()).split(CHUNK)
        ]
        return (torch.cat(values) - constant).to(z)
