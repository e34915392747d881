"""Compares a learnt posterior with the simulator's own likelihood, and corrects it.

A learnt density q(z | x) is an approximation. If the recording has a likelihood, draws of q are
weighted by p(x | z) p(z) / q(z). Equal weights mean that q is right. If they are unequal, q is
replaced by draws of the posterior itself, whose first proposals are q and the closest fit; see
:mod:`npdr_ppl.preparation.importance_sampling`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.inference.parts.samplers.importance_weights import longest_step, systematic
from npdr_ppl.language.prior import Prior
from npdr_ppl.posterior.settings import ESTIMATOR_CHECK
from npdr_ppl.preparation.importance_sampling import sample_posterior
from npdr_ppl.preparation.ridges import RidgeCoordinates
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.weighted_draws import WeightedDraws, effective_size, smoothed_weights
from npdr_ppl.randomness import seeded

__all__ = ["Correction", "EstimatorCheck", "check_estimator"]

MIXTURE_PARTS = ("log_weights", "means", "precision_factors")


@dataclass(frozen=True)
class EstimatorCheck:
    """How a learnt posterior compares with the simulator.

    Attributes:
        learnt_pareto_k: Tail index of the weights of its draws; reliable up to 0.7.
        learnt_effective_share: Effective sample size of its draws, as a share of their number.
        is_corrected: Whether it was replaced.
        pareto_k: Tail index of the weights of the present posterior's draws.
        effective: Their effective sample size.
        is_reliable: Whether the present posterior agrees with the likelihood.
    """

    learnt_pareto_k: float
    learnt_effective_share: float
    is_corrected: bool
    pareto_k: float
    effective: float
    is_reliable: bool

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values; a value that is not finite is null."""
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
        """Returns the log density, ``(n,)``, at points of the support, ``(n, d)``."""
        values = [
            self.mixture.log_prob(self.space.from_reference(part.double()))
            + self.space.log_jacobian(part.double())
            for part in z.split(ESTIMATOR_CHECK.points_per_part)
        ]
        return torch.cat(values).to(z)


@dataclass(frozen=True)
class Correction:
    """The posterior that replaces a learnt one.

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
    densities: Sequence[Density],
    likelihood: SegmentLikelihood,
    *,
    seed: int,
    corrects: bool,
    report: Callable[[str], None] = lambda _: None,
) -> tuple[EstimatorCheck, Correction | None]:
    """Compares a learnt posterior with the simulator, and corrects it where they differ.

    Args:
        densities: The learnt posterior's members, in reference coordinates.
        likelihood: The recording's likelihood.
        seed: Seed of the draws.
        corrects: Whether to correct it.
        report: Called with a short status while it is corrected.

    Returns:
        The comparison, and the corrected posterior; ``None`` if the learnt one is kept.
    """
    learnt = Mixture(densities)
    prior = likelihood.segments.prior
    with seeded(seed, "check estimator"), torch.no_grad():
        z = learnt.sample(ESTIMATOR_CHECK.num_draws).double().cpu()
        log_weights = (
            likelihood.log_prob(z) + prior.log_prob(z) - learnt.log_prob(z).double().cpu()
        )
    smoothed, k = smoothed_weights(log_weights)
    share = effective_size(smoothed) / len(z)
    is_covered = k <= IMPORTANCE_SAMPLING.reliable_k
    if is_covered and share >= ESTIMATOR_CHECK.least_effective_share:
        return EstimatorCheck(k, share, False, k, share * len(z), True), None
    if not corrects:
        agrees = is_covered and share >= ESTIMATOR_CHECK.agreeing_share
        return EstimatorCheck(k, share, False, k, share * len(z), agrees), None
    with torch.no_grad():
        draws = sample_posterior(likelihood, [learnt], seed=seed, report=report)
    check = EstimatorCheck(k, share, True, draws.k_hat, draws.effective, draws.is_reliable)
    return check, _corrected(draws, seed)


def _corrected(draws: WeightedDraws, seed: int) -> Correction:
    """Returns kernel density estimates of disjoint parts of weighted draws."""
    # If only a few draws have a weight, tempered weights make the posterior wider; the check then
    # reports that it is not reliable.
    finite = int(draws.log_weights.isfinite().sum())
    wanted = min(1.0, IMPORTANCE_SAMPLING.least_effective / max(1, finite))
    exponent = longest_step(draws.log_weights, 1.0, wanted)
    log_weights = torch.where(
        draws.log_weights.isfinite(), exponent * draws.log_weights, -torch.inf
    )
    chains, kernels = ESTIMATOR_CHECK.num_chains, ESTIMATOR_CHECK.num_kernels
    bandwidth = ESTIMATOR_CHECK.bandwidth
    densities = []
    for chain in range(chains):
        w, own = draws.w[chain::chains], log_weights[chain::chains].log_softmax(0)
        weights = own.exp()
        mean = weights @ w
        away = w - mean
        covariance = (weights[:, None] * away).mT @ away
        covariance = covariance + torch.diag(1e-12 + 1e-9 * covariance.diagonal())
        with seeded(seed, "corrected posterior", chain):
            centres = w[systematic(own, kernels)]
        mixture = GaussianMixture.from_moments(
            torch.full((kernels,), 1.0 / kernels, dtype=torch.float64),
            mean + math.sqrt(1.0 - bandwidth**2) * (centres - mean),
            (bandwidth**2 * covariance).expand(kernels, *covariance.shape),
        )
        densities.append(RidgeDensity(draws.space, mixture))
    return Correction(tuple(densities))
