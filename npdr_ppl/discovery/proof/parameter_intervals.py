"""The uncertainty of a hypothesis's parameters: draws of its posterior, and their summaries."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.settings import INTERVALS
from npdr_ppl.inference.parts.samplers.importance_weights import systematic
from npdr_ppl.preparation.importance_sampling import laplace_draws, sample_posterior
from npdr_ppl.preparation.sampling_settings import IMPORTANCE_SAMPLING
from npdr_ppl.randomness import derived_seed

__all__ = ["Draws", "Estimate", "estimates", "posterior_draws", "quick_draws"]


@dataclass(frozen=True)
class Estimate:
    """A summary of a parameter's posterior.

    Attributes:
        mean: Mean, in ``unit``.
        sd: Standard deviation.
        hdi_94: The shortest interval that contains 94 % of the probability.
        unit: Its unit.
    """

    mean: float
    sd: float
    hdi_94: tuple[float, float]
    unit: str

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values; numbers that are not finite become ``None``."""
        mean, sd, low, high = (
            value if math.isfinite(value) else None for value in (self.mean, self.sd, *self.hdi_94)
        )
        return {"mean": mean, "sd": sd, "hdi_94": [low, high], "unit": self.unit}


@dataclass(frozen=True)
class Draws:
    """Weighted draws of a posterior.

    Attributes:
        z: Reference coordinates, ``(n, d)``.
        weights: Their weights, ``(n,)``, with a sum of one.
    """

    z: Tensor
    weights: Tensor

    def smoothed(self) -> "Draws":
        """Returns draws with smooth marginals of the same mean and variance (West 1993)."""
        mean = self.weights @ self.z
        sd = (self.weights @ (self.z - mean).square()).sqrt()
        places = torch.special.ndtri(
            (torch.arange(INTERVALS.copies).double() + 0.5) / INTERVALS.copies
        )
        shrunk = mean + (1.0 - INTERVALS.bandwidth**2) ** 0.5 * (self.z - mean)
        smeared = shrunk[:, None] + INTERVALS.bandwidth * (places / places.std())[:, None] * sd
        return Draws(
            smeared.flatten(0, 1),
            self.weights.repeat_interleave(INTERVALS.copies) / INTERVALS.copies,
        )

    def resampled(self, num: int) -> Tensor:
        """Returns draws of equal weight, ``(num, d)``, chosen from torch's global stream."""
        return self.z[systematic(self.weights.log(), num)]


def posterior_draws(hypothesis: Hypothesis, *, seed: int, is_rough: bool = False) -> Draws:
    """Returns draws of the posterior, given the recording.

    See :mod:`npdr_ppl.preparation.importance_sampling`.

    Args:
        hypothesis: The fitted model.
        seed: Seed of the draws.
        is_rough: Whether rough intervals will do, because the model lacks effects: then the draws
            take at most ``INTERVALS.rough_iterations`` proposals, and ridges are taken as
            straight.

    Raises:
        DataError: Simulations fail close to the fit.
    """
    own_seed = derived_seed(seed, "discovery", "posterior")
    found = sample_posterior(
        hypothesis.likelihood,
        seed=own_seed,
        is_rough=is_rough,
        most_iterations=INTERVALS.rough_iterations if is_rough else None,
    )
    counts = found.weights > 0.0  # without failed simulations, whose parameters can be anything
    return Draws(found.z[counts], found.weights[counts])


def quick_draws(hypothesis: Hypothesis, *, seed: int) -> Draws:
    """Returns draws of Laplace's approximation of the posterior, which take no simulations.

    Rough ones by importance sampling if hardly any of them is in the prior's support.

    Args:
        hypothesis: The fitted model.
        seed: Seed of the draws.
    """
    own_seed = derived_seed(seed, "discovery", "posterior")
    z = laplace_draws(hypothesis.likelihood, INTERVALS.quick_draws, seed=own_seed)
    if len(z) < IMPORTANCE_SAMPLING.enough_effective:
        return posterior_draws(hypothesis, seed=seed, is_rough=True)
    return Draws(z, torch.full((len(z),), 1.0 / len(z), dtype=torch.float64))


def estimates(
    hypothesis: Hypothesis, draws: Draws, units: Mapping[str, str]
) -> dict[str, Estimate]:
    """Returns the estimate of every scalar parameter, by site.

    Args:
        hypothesis: The fitted model.
        draws: Draws of its posterior.
        units: The parameters' units.
    """
    draws = draws.smoothed()
    values = hypothesis.segments.prior.to_parameters(draws.z)
    result = {}
    for name, value in values.items():
        if value[0].numel() == 1:
            column = value.double().flatten()
            mean = draws.weights @ column
            sd = (draws.weights @ (column - mean).square()).sqrt()
            interval = _shortest(column, draws.weights)
            result[name] = Estimate(float(mean), float(sd), interval, units.get(name, ""))
    return result


def _shortest(values: Tensor, weights: Tensor) -> tuple[float, float]:
    """Returns the ends of the shortest interval with the probability ``INTERVALS.mass``."""
    ordered, order = values.sort()
    # Half of a draw's weight is on each side of it.
    mass = weights[order].cumsum(0) - 0.5 * weights[order]
    end = torch.searchsorted(mass, mass + INTERVALS.mass)
    inside = end < len(ordered)
    widths = torch.where(inside, ordered[end.clamp_max(len(ordered) - 1)] - ordered, math.inf)
    start = int(widths.argmin())
    if not bool(inside[start]):
        return float(ordered[0]), float(ordered[-1])
    return float(ordered[start]), float(ordered[end[start]])
