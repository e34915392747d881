"""Adaptive importance sampling of a posterior whose likelihood can be evaluated.

Draws z_i of proposals q_t are weighted by p(recording | z) p(z) / Σ_t n_t/n q_t(z), the mixture of
all proposals so far (deterministic mixture weights; Cornuet, Marin, Mira & Robert 2012). If the
weights are too unequal, the next proposal is a kernel density estimate of the weighted draws,
which follows curved ridges. The tail of the weights, fitted by Pareto smoothing, shows whether
they are reliable (Vehtari, Simpson, Gelman, Yao & Gabry 2024).

Where polynomials represent the residuals, draws need far fewer simulations; this is tried first,
see :mod:`npdr_ppl.preparation.surrogate_sampling`. Otherwise, an ensemble of the draws moves along
ridges by Markov chain Monte Carlo, because proposals give too few draws at their ends. That is
not needed if Laplace's approximation with its heavy tails suffices: the posterior is then nearly
normal in these coordinates, and the tails reach its ends.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.inference.parts.samplers.importance_weights import longest_step, systematic
from npdr_ppl.inference.parts.samplers.walkers import ensemble_draws
from npdr_ppl.preparation.density_surrogate import DensitySurrogate
from npdr_ppl.preparation.ridges import RidgeCoordinates, log_density_of
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.surrogate_sampling import surrogate_draws
from npdr_ppl.preparation.weighted_draws import WeightedDraws, effective_size, smoothed_weights
from npdr_ppl.randomness import derived_seed, seeded

__all__ = [
    "laplace_draws",
    "sample_posterior",
]


@dataclass(frozen=True)
class _Proposal:
    """One component of the mixture of all proposals.

    Attributes:
        density: The proposal.
        num_draws: Number of draws it contributes.
        space: Coordinates in which it is a density; None for reference coordinates.
    """

    density: Density
    num_draws: int
    space: RidgeCoordinates | None = None

    def log_prob(self, z: Tensor, w: Tensor) -> Tensor:
        """Returns log(number of draws × density) over reference coordinates, ``(n,)``.

        Args:
            z: Reference coordinates of the points, ``(n, d)``.
            w: The same points in coordinates in which ridges are straight, ``(n, d)``.
        """
        if self.space is None:
            log_density = self.density.log_prob(z).double().cpu()
        else:
            log_density = self.density.log_prob(w).double() + self.space.log_jacobian(z)
        return (log_density + math.log(self.num_draws)).nan_to_num(-math.inf, -math.inf, -math.inf)


def sample_posterior(
    likelihood: SegmentLikelihood,
    proposals: Sequence[Density] = (),
    *,
    seed: int,
    is_rough: bool = False,
    most_iterations: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> WeightedDraws:
    """Draws from the posterior of a recording.

    Draws with polynomials in place of the simulator are tried first; see
    :mod:`npdr_ppl.preparation.surrogate_sampling`. Where these do not suffice, they come from
    adaptive importance sampling. Its first proposal is Laplace's approximation at the closest fit,
    in coordinates in which ridges are straight; see :mod:`npdr_ppl.preparation.ridges`.

    Args:
        likelihood: The recording's likelihood.
        proposals: Further first proposals, densities over reference coordinates; for example
            posteriors that a backend has learnt.
        seed: Seed of the draws.
        is_rough: Whether polynomials are not tried, ridges are taken as straight, and draws do not
            move on to their ends.
        most_iterations: Greatest number of proposals; that of the settings by default.
        report: Called with a short status after each proposal.
    """
    prior = likelihood.segments.prior
    space = RidgeCoordinates.of(likelihood, seed=seed, is_rough=is_rough)
    if not is_rough:
        found = surrogate_draws(likelihood, space, proposals, seed=seed, report=report)
        if found is not None:
            return found
    settings = IMPORTANCE_SAMPLING
    own = [_Proposal(space.heavy_tailed(), settings.draws_per_iteration, space)]
    given = [_Proposal(density, settings.draws_of_given) for density in proposals]
    z, w, target, log_mixture = (torch.empty(0, dtype=torch.float64) for _ in range(4))
    result: WeightedDraws | None = None
    for iteration in range(most_iterations or settings.most_iterations):
        with seeded(seed, "importance", iteration):
            new_w = own[-1].density.sample(settings.draws_per_iteration).double()
            new_z, inside = space.to_reference(new_w)
            if iteration == 0:
                drawn = [one.density.sample(one.num_draws).double().cpu() for one in given]
                new_z = torch.cat((new_z, *drawn))
                new_w = torch.cat((new_w, *(space.from_reference(part) for part in drawn)))
                inside = torch.cat((inside, inside.new_ones(len(new_z) - len(inside))))
        new = torch.full((len(new_z),), -torch.inf, dtype=torch.float64)
        at = new_z[inside]
        if len(at):
            new[inside] = likelihood.log_prob(at) + prior.log_prob(at)
        if iteration > 0:  # the mixture at earlier draws lacks the newest proposal only
            log_mixture = torch.logaddexp(log_mixture, own[-1].log_prob(z, w))
        new_mixture = torch.stack([one.log_prob(new_z, new_w) for one in own + given])
        log_mixture = torch.cat((log_mixture, new_mixture.logsumexp(0)))
        z, w = (new_z, new_w) if iteration == 0 else (torch.cat((z, new_z)), torch.cat((w, new_w)))
        target = torch.cat((target, new))
        log_weights = (target - log_mixture).nan_to_num(-math.inf, -math.inf, -math.inf)
        smoothed, k_hat = smoothed_weights(log_weights)
        size = effective_size(smoothed)
        result = WeightedDraws(z, w, space, smoothed, k_hat, size, iteration + 1)
        # If hardly any draw has a weight, all are set equal; see :func:`smoothed_weights`.
        size = size if math.isfinite(k_hat) else 0.0
        wanted = settings.enough_effective
        report(f"{len(z)} draws, {min(size, wanted):.0f} of {wanted:.0f} effective ones")
        if result.has_enough:
            break
        if iteration + 1 >= settings.iterations_to_adapt and size < z.shape[1]:
            break
        adapted = _adapted(w, log_weights, seed, iteration)
        own.append(_Proposal(adapted, settings.draws_per_iteration, space))
    assert result is not None
    is_nearly_normal = result.iterations == 1 and not given
    if space.num_weak and result.is_reliable and not is_nearly_normal:
        report(f"{len(z)} draws, moving some of them along the posterior's ridges")
        return _moved(result, target, likelihood, seed)
    return result


def laplace_draws(likelihood: SegmentLikelihood, num: int, *, seed: int) -> Tensor:
    """Draws from Laplace's approximation of the posterior at the closest fit, ``(≤ num, d)``.

    It takes no simulations beside the derivatives at the fit. Draws outside the prior's support
    are left out.

    Args:
        likelihood: The recording's likelihood.
        num: Number of draws.
        seed: Seed of the draws.
    """
    space = RidgeCoordinates.of(likelihood, seed=seed, is_rough=True)
    mean, covariance = space.moments()
    with seeded(seed, "laplace"):
        w = torch.distributions.MultivariateNormal(mean, covariance).sample((num,))
    z, inside = space.to_reference(w)
    return z[inside]


def _known(draws: WeightedDraws, target: Tensor) -> Tensor:
    """Returns the log density of draws over w, ``(n,)``, from that over reference coordinates."""
    return torch.where(target.isfinite(), target - draws.space.log_jacobian(draws.z), -torch.inf)


def _moved(
    draws: WeightedDraws, target: Tensor, likelihood: SegmentLikelihood, seed: int
) -> WeightedDraws:
    """Returns draws of equal weight, after moves that lead them to the ends of a ridge.

    Importance sampling places few draws there, and Pareto smoothing makes their weights too small.

    Args:
        draws: The draws.
        target: Their log density over reference coordinates, ``(n,)``.
        likelihood: The recording's likelihood.
        seed: Seed of the moves.
    """
    settings = IMPORTANCE_SAMPLING
    surrogate = DensitySurrogate.of(draws.w, draws.log_weights, _known(draws, target))
    with seeded(seed, "walkers"):
        first = draws.w[systematic(draws.log_weights, settings.num_walkers)]
    w = ensemble_draws(
        log_density_of(likelihood, draws.space),
        first,
        sweeps=settings.sweeps if surrogate else settings.sweeps_alone,
        interval=settings.sweeps_between_draws,
        generator=torch.Generator().manual_seed(derived_seed(seed, "ensemble")),
        surrogate=surrogate,
    )
    log_weights = torch.full((len(w),), -math.log(len(w)), dtype=torch.float64)
    return replace(draws, z=draws.space.to_reference(w)[0], w=w, log_weights=log_weights)


def _adapted(y: Tensor, log_weights: Tensor, seed: int, iteration: int) -> GaussianMixture:
    """Returns the next proposal: a kernel density estimate of the weighted draws.

    If few draws have most of the weight, the weights are tempered, so that the proposal
    approaches the posterior over several iterations.
    """
    d = y.shape[1]
    exponent = longest_step(
        log_weights, 1.0, min(0.5, IMPORTANCE_SAMPLING.effective_per_parameter * d / len(y))
    )
    tempered = torch.where(log_weights.isfinite(), exponent * log_weights, -torch.inf)
    if not bool(tempered.isfinite().any()):
        tempered = torch.zeros_like(tempered)
    weights = tempered.softmax(0)
    mean = weights @ y
    away = y - mean
    covariance = (weights[:, None] * away).mT @ away
    covariance = covariance + 1e-10 * torch.diag(covariance.diagonal().clamp_min(1e-12))
    with seeded(seed, "kernels", iteration):
        centres = y[systematic(weights.log(), IMPORTANCE_SAMPLING.num_kernels)]
    width = (4.0 / (d + 2) / IMPORTANCE_SAMPLING.num_kernels) ** (
        1.0 / (d + 4)
    )  # Silverman's rule
    shrunk = mean + math.sqrt(max(0.0, 1.0 - min(1.0, width) ** 2)) * (centres - mean)
    return GaussianMixture.from_moments(
        torch.cat(
            (
                torch.full(
                    (IMPORTANCE_SAMPLING.num_kernels,),
                    IMPORTANCE_SAMPLING.tails[0][0] / IMPORTANCE_SAMPLING.num_kernels,
                    dtype=torch.float64,
                ),
                torch.tensor(
                    [weight for weight, _ in IMPORTANCE_SAMPLING.tails[1:]], dtype=torch.float64
                ),
            )
        ),
        torch.cat((shrunk, mean.expand(len(IMPORTANCE_SAMPLING.tails) - 1, -1))),
        torch.cat(
            (
                (width**2 * covariance).expand(IMPORTANCE_SAMPLING.num_kernels, d, d),
                torch.stack([factor * covariance for _, factor in IMPORTANCE_SAMPLING.tails[1:]]),
            )
        ),
    )
