"""Is a learnt posterior what the simulator itself says?

A learnt density q(z | x) is an approximation. Where the recording has a likelihood, draws of q are
weighted by p(x | z) p(z) / q(z): even weights mean that q is right. If they are uneven, q is
replaced by draws of the posterior itself, which start from q and from the closest fit; see
:mod:`npdr_ppl.preparation.importance_sampling`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.inference.parts.samplers.importance_weights import longest_step, systematic
from npdr_ppl.language.prior import Prior
from npdr_ppl.preparation.importance_sampling import (
    WeightedDraws,
    effective_size,
    sample_posterior,
    smoothed_weights,
)
from npdr_ppl.preparation.ridges import RidgeCoordinates
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.settings import IMPORTANCE_SAMPLING
from npdr_ppl.randomness import seeded

__all__ = ["Correction", "EstimatorCheck", "check_estimator"]

CHECKED_DRAWS = 256
"""Draws of a learnt posterior that are weighted, each a simulation of the recording."""

RIGHT_SHARE = 0.99
"""Share of these draws that must be worth an independent one for the learnt posterior to be kept.
Its tails may be heavier than the posterior's: at a share of 0.92 one draw in a thousand was eleven
standard deviations away, which spoilt every segment's leave-one-out weights."""

CHAINS = 2
"""Disjoint sets of draws that a corrected posterior is made of, to compare with each other."""

KERNELS = 256
"""Components of a corrected posterior's density in each chain."""

BANDWIDTH = 0.2
"""Standard deviation of these components, in the posterior's (West 1993 shrinks them towards the
mean, so that the variance stays)."""


MIXTURE_PARTS = ("log_weights", "means", "precision_factors")

POINTS_TOGETHER = 2_000
"""Points at which a corrected density is computed at once: with all its components they take some
ten megabytes per parameter."""


@dataclass(frozen=True)
class EstimatorCheck:
    """How a learnt posterior compares with the simulator.

    Attributes:
        learnt_pareto_k: Tail index of the weights of its draws; reliable up to 0.7.
        learnt_effective_share: Share of its draws that are worth an independent one.
        is_corrected: Whether it was replaced.
        pareto_k: Tail index of the weights of the draws that the posterior is made of now.
        effective: Their effective sample size.
        is_reliable: Whether the posterior is what the simulator says.
    """

    learnt_pareto_k: float
    learnt_effective_share: float
    is_corrected: bool
    pareto_k: float
    effective: float
    is_reliable: bool

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values; what is not finite is null."""
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(self).items()
        }


class RidgeDensity(Density):
    """A mixture of normal densities in coordinates in which a posterior's ridges are straight.

    Attributes:
        space: The coordinates.
        mixture: The mixture.
    """

    def __init__(self, space: RidgeCoordinates, mixture: GaussianMixture) -> None:
        self.space = space
        self.mixture = mixture

    def sample(self, num_samples: int) -> Tensor:
        """Draws ``(num_samples, d)`` on the prior's support from torch's global stream."""
        found: list[Tensor] = []
        while sum(map(len, found)) < num_samples:
            z, inside = self.space.to_reference(self.mixture.sample(num_samples).double())
            found.append(z[inside])
            if not bool(inside.any()):  # kernels on the very edge of the support
                found.append(self.space.to_reference(self.mixture.means)[0][:num_samples])
        return torch.cat(found)[:num_samples]

    def log_prob(self, z: Tensor) -> Tensor:
        """Returns the log density at ``(n, d)``, shape ``(n,)``, but for what lies off support."""
        values = [
            self.mixture.log_prob(self.space.from_reference(part.double()))
            + self.space.log_jacobian(part.double())
            for part in z.split(POINTS_TOGETHER)
        ]
        return torch.cat(values).to(z)


@dataclass(frozen=True)
class Correction:
    """What takes the place of a learnt posterior.

    Attributes:
        densities: Its chains.
    """

    densities: tuple[RidgeDensity, ...]

    def tensors(self) -> dict[str, Tensor]:
        """Returns the densities as tensors, to be written to disk."""
        result = {f"space_{k}": v for k, v in self.densities[0].space.tensors().items()}
        for index, density in enumerate(self.densities):
            for part in MIXTURE_PARTS:
                result[f"{index}_{part}"] = getattr(density.mixture, part)
        return result

    @classmethod
    def of_tensors(cls, prior: Prior, tensors: Mapping[str, Tensor]) -> "Correction":
        """Rebuilds what :meth:`tensors` returned."""
        space = RidgeCoordinates.of_tensors(
            prior,
            {k.removeprefix("space_"): v for k, v in tensors.items() if k.startswith("space_")},
        )
        number = sum(name.endswith(f"_{MIXTURE_PARTS[0]}") for name in tensors)
        return cls(
            tuple(
                RidgeDensity(
                    space, GaussianMixture(*(tensors[f"{k}_{part}"] for part in MIXTURE_PARTS))
                )
                for k in range(number)
            )
        )


def check_estimator(
    densities: Sequence[Density], likelihood: SegmentLikelihood, *, seed: int, corrects: bool
) -> tuple[EstimatorCheck, Correction | None]:
    """Compares a learnt posterior with the simulator, and corrects it where they differ.

    Args:
        densities: The learnt posterior's members, in reference coordinates.
        likelihood: The recording's likelihood.
        seed: Seed of the draws.
        corrects: Whether to correct it.

    Returns:
        The comparison, and what takes the posterior's place, ``None`` if it stays.
    """
    learnt = Mixture(densities)
    prior = likelihood.segments.prior
    with seeded(seed, "check estimator"), torch.no_grad():
        z = learnt.sample(CHECKED_DRAWS).double().cpu()
        log_weights = (
            likelihood.log_prob(z) + prior.log_prob(z) - learnt.log_prob(z).double().cpu()
        )
    smoothed, k = smoothed_weights(log_weights)
    share = effective_size(smoothed) / len(z)
    if k <= IMPORTANCE_SAMPLING.reliable_k and share >= RIGHT_SHARE:
        return EstimatorCheck(k, share, False, k, share * len(z), True), None
    if not corrects:
        return EstimatorCheck(k, share, False, k, share * len(z), False), None
    with torch.no_grad():
        draws = sample_posterior(likelihood, [learnt], seed=seed)
    check = EstimatorCheck(k, share, True, draws.k_hat, draws.effective, draws.is_reliable)
    return check, _corrected(draws, seed)


def _corrected(draws: WeightedDraws, seed: int) -> Correction:
    """Returns kernel density estimates of disjoint parts of weighted draws."""
    # Where hardly any draw has a weight the posterior is drawn wider instead, and the check says
    # that it is not reliable.
    finite = int(draws.log_weights.isfinite().sum())
    wanted = min(1.0, 0.5 * IMPORTANCE_SAMPLING.enough_effective / max(1, finite))
    exponent = longest_step(draws.log_weights, 1.0, wanted)
    log_weights = torch.where(
        draws.log_weights.isfinite(), exponent * draws.log_weights, -torch.inf
    )
    densities = []
    for chain in range(CHAINS):
        w, own = draws.w[chain::CHAINS], log_weights[chain::CHAINS].log_softmax(0)
        weights = own.exp()
        mean = weights @ w
        away = w - mean
        covariance = (weights[:, None] * away).mT @ away
        covariance = covariance + torch.diag(1e-12 + 1e-9 * covariance.diagonal())
        with seeded(seed, "corrected posterior", chain):
            centres = w[systematic(own, KERNELS)]
        mixture = GaussianMixture.from_moments(
            torch.full((KERNELS,), 1.0 / KERNELS, dtype=torch.float64),
            mean + math.sqrt(1.0 - BANDWIDTH**2) * (centres - mean),
            (BANDWIDTH**2 * covariance).expand(KERNELS, *covariance.shape),
        )
        densities.append(RidgeDensity(draws.space, mixture))
    return Correction(tuple(densities))
