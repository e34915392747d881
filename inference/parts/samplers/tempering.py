"""Sampling from a density known up to a constant: tempered sequential Monte Carlo.

A cloud of particles moves from the prior p(z) to the posterior, proportional to p(z) L(z), through

    pi_b(z) proportional to p(z) L(z)^b,        0 = b_0 < b_1 < ... < 1

(Neal 2001; Del Moral, Doucet & Jasra 2006). Each exponent is chosen so that the effective sample
size of the incremental weights L^(b_k - b_(k-1)) is a fixed share of the particles. The particles
are then resampled. They move by elliptical slice sampling generalised to any target (Murray, Adams
& MacKay 2010; Nishihara, Murray & Adams 2014, https://arxiv.org/abs/1210.7477), which has no step
size to tune. All particles move in one batch. Modes keep their weights, because particles need not
cross between them. The product of the weights' means is the evidence

    Z = integral p(z) L(z) dz.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Density, Problem
from npdr_ppl.inference.parts.samplers.importance_weights import longest_step, systematic
from npdr_ppl.randomness import seeded

__all__ = ["Particles", "UnnormalisedDensity", "tempered_particles"]

LogDensity = Callable[[Tensor], Tensor]
"""Maps points ``(n, d)`` to log densities ``(n,)``."""

EFFECTIVE_SHARE = 0.5
"""Effective sample size of the incremental weights, as a share of the particles."""

MAX_SWEEPS, MAX_FINAL_SWEEPS = 5, 24
"""Maximum number of slice updates of each particle after a resampling, and at the end. Particles
that never leave their mode stay correlated with their initial positions for any number of
updates."""

DECORRELATED = 0.1
"""Particles have moved far enough once their correlation with their initial positions, the maximum
over all coordinates, is this small."""

MAX_SHRINKS = 40
"""Maximum number of shrinkings of a slice; each roughly halves it. Then the particle stays where
it is."""

MAX_STAGES = 200
"""Maximum number of exponents; then an error reports that the likelihood is too peaked."""

MIN_PARTICLES = 1_000
"""Minimum number of particles: fewer lose modes and give a poor estimate of the covariance."""

CHUNK = 16_384
"""Points evaluated in one batch."""

NUM_KERNELS, NUM_EVIDENCE_POINTS = 200, 20_000
"""Number of Gaussians of the proposal that estimates the evidence, and of points drawn from it."""


@dataclass(frozen=True)
class Particles:
    """A sample of the posterior.

    Attributes:
        z: Points, ``(n, d)``, equally weighted.
        log_evidence: Log of Z.
        stages: Number of exponents.
    """

    z: Tensor
    log_evidence: float
    stages: int


def tempered_particles(
    problem: Problem, log_likelihood: LogDensity, num_particles: int
) -> Particles:
    """Draws from p(z) L(z) / Z; all randomness is from torch's global stream.

    Args:
        problem: Gives the prior.
        log_likelihood: log L; a particle at which it is not finite has no weight.
        num_particles: Number of particles n.

    Raises:
        BackendError: The likelihood vanishes at all draws of the prior, or is so peaked that
            :data:`MAX_STAGES` exponents do not reach it.
    """

    def evaluate(z: Tensor) -> Tensor:
        with torch.no_grad():
            values = torch.cat([log_likelihood(part) for part in z.split(CHUNK)])
        return torch.where(values.isfinite(), values.double(), -torch.inf)

    z = problem.sample_prior(num_particles)
    log_like = evaluate(z)
    if not log_like.isfinite().any():
        raise BackendError("The likelihood vanishes, or is not finite, at every prior draw.")
    exponent, log_evidence, stages = 0.0, 0.0, 0
    while exponent < 1.0:
        if stages == MAX_STAGES:
            raise BackendError(
                f"The likelihood is too peaked: {MAX_STAGES} steps of tempering reached the "
                f"exponent {exponent:.2g} of 1."
            )
        step = longest_step(log_like, 1.0 - exponent, EFFECTIVE_SHARE)
        log_weight = step * log_like
        log_evidence += float(log_weight.logsumexp(0)) - math.log(num_particles)
        chosen = systematic(log_weight, num_particles)
        z, log_like = z[chosen], log_like[chosen]
        exponent = 1.0 if step >= 1.0 - exponent else exponent + step
        stages += 1
        start = z
        for _ in range(MAX_FINAL_SWEEPS if exponent == 1.0 else MAX_SWEEPS):
            z, log_like = _slice_sweep(z, log_like, exponent, evaluate, problem.log_prior)
            if _correlation(start, z) < DECORRELATED:
                break
    return Particles(z, log_evidence, stages)


def _correlation(start: Tensor, end: Tensor) -> float:
    """Returns the maximum correlation over all coordinates of ``(n, d)`` points."""
    a, b = start - start.mean(0), end - end.mean(0)
    scale = (a.square().mean(0) * b.square().mean(0)).sqrt().clamp_min(1e-30)
    return float(((a * b).mean(0) / scale).max())


def _slice_sweep(
    z: Tensor,
    log_like: Tensor,
    exponent: float,
    evaluate: LogDensity,
    log_prior: LogDensity,
) -> tuple[Tensor, Tensor]:
    """Moves every particle by one elliptical slice update that leaves pi_b invariant.

    The ellipse passes through a particle and a draw of the Gaussian N(m, C) that fits the cloud;
    the slice is that of pi_b(z) / N(z; m, C). Particles influence each other only by sharing this
    Gaussian.
    """
    n, d = z.shape
    mean = z.mean(0)
    covariance = (z - mean).double().T @ (z - mean).double() / n
    jitter = 1e-6 * covariance.diagonal().clamp_min(1e-12)
    factor = torch.linalg.cholesky(covariance + torch.diag(jitter)).to(z)

    def excess(points: Tensor, values: Tensor) -> Tensor:
        white = torch.linalg.solve_triangular(factor, (points - mean).T, upper=False).T
        return exponent * values + log_prior(points).double() + 0.5 * white.square().sum(-1)

    centred = z - mean
    other = torch.randn(n, d) @ factor.T
    level = excess(z, log_like) + torch.rand(n).log()
    angle = 2 * math.pi * torch.rand(n)
    low, high = angle - 2 * math.pi, angle.clone()
    result, result_like = z.clone(), log_like.clone()
    active = torch.arange(n)
    for _ in range(MAX_SHRINKS):
        a = angle[active, None]
        points = centred[active] * a.cos() + other[active] * a.sin() + mean
        values = evaluate(points)
        accepted = excess(points, values) > level[active]
        done = active[accepted]
        result[done], result_like[done] = points[accepted], values[accepted]
        active = active[~accepted]
        if not len(active):
            break
        tried = angle[active]
        low[active] = torch.where(tried < 0, tried, low[active])
        high[active] = torch.where(tried < 0, high[active], tried)
        angle[active] = low[active] + (high[active] - low[active]) * torch.rand(len(active))
    return result, result_like


class UnnormalisedDensity(Density):
    """A posterior p(z) L(z) / Z given by its likelihood.

    The first call that needs Z estimates it once, from a separate random stream; its error is
    about 1 %.

    Args:
        problem: Gives the prior.
        log_likelihood: log L, differentiable.
        draws: Draws ``(n, d)`` made by other means; without them, particles are tempered for
            every sample.
    """

    def __init__(
        self, problem: Problem, log_likelihood: LogDensity, draws: Tensor | None = None
    ) -> None:
        self._problem = problem
        self._log_likelihood = log_likelihood
        self._draws = draws
        self._log_z: float | None = None

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` from torch's global stream.

        If draws were given, as few of them as possible are repeated.
        """
        if self._draws is not None:
            n = len(self._draws)
            repeats = [torch.randperm(n) for _ in range(-(-num_samples // n))]
            return self._draws[torch.cat(repeats)[:num_samples]]
        num_particles = max(num_samples, MIN_PARTICLES)
        particles = tempered_particles(self._problem, self._log_likelihood, num_particles)
        return particles.z[torch.randperm(num_particles)[:num_samples]]

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``; differentiable in z."""
        return self._log_likelihood(z) + self._problem.log_prior(z) - self._log_evidence()

    def _log_evidence(self) -> float:
        """Returns log Z by importance sampling from a mixture around tempered particles."""
        if self._log_z is None:
            with seeded(0, "evidence"), torch.no_grad():
                self._log_z = self._estimate_log_evidence()
        return self._log_z

    def _estimate_log_evidence(self) -> float:
        z = self.sample(MIN_PARTICLES)
        proposal = kernel_mixture(z, NUM_KERNELS)
        points = proposal.sample((NUM_EVIDENCE_POINTS,))
        log_weight = torch.cat(
            [
                self._log_likelihood(part) + self._problem.log_prior(part)
                for part in points.split(CHUNK)
            ]
        ).double()
        log_weight = log_weight - proposal.log_prob(points).double()
        log_weight = torch.where(log_weight.isfinite(), log_weight, -torch.inf)
        return float(log_weight.logsumexp(0)) - math.log(len(points))


def kernel_mixture(z: Tensor, num_kernels: int) -> MixtureSameFamily:
    """Returns an equal mixture of Gaussians at draws, with widths from Silverman's rule.

    Args:
        z: Draws of a density, ``(n, d)``.
        num_kernels: Maximum number of Gaussians.
    """
    centres = z[torch.randperm(len(z))[:num_kernels]]
    n, d = centres.shape
    bandwidth = (4 / (n * (d + 2))) ** (1 / (d + 4))
    covariance = z.T.cov().reshape(d, d)
    covariance = covariance + torch.diag(1e-6 * covariance.diagonal().clamp_min(1e-12))
    factor = bandwidth * torch.linalg.cholesky(covariance)
    return MixtureSameFamily(
        Categorical(logits=torch.zeros(n)),
        MultivariateNormal(centres, scale_tril=factor, validate_args=False),
        validate_args=False,
    )
