"""How sure the parameters of a hypothesis are.

A normal approximation with a robust covariance is drawn from, evenly, and each draw is weighed by
how the misfit there differs from the parabola's: where the simulation is linear in the parameters
all weights are one, and along a ridge that bends, as that of a weak spring whose rest is far away,
draws that leave it have none.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.inference.importance import longest_step, systematic
from npdr_ppl.randomness import derived_seed
from npdr_ppl.workflows.discovery.chance import block_sums
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis
from npdr_ppl.workflows.discovery.projection import Projection
from npdr_ppl.workflows.segment_fit import MAX_COORDINATE

__all__ = ["Draws", "Estimate", "estimates", "posterior_draws"]

NUM_PROPOSALS = 256
"""Draws of the normal approximation, each a simulation of the recording. A power of two, for
Sobol's sequence; evenly spread they say as much as some thousand random ones."""

LEAST_EFFECTIVE = 0.125
"""Share of the draws, those that could be simulated, that are to be worth an independent one."""

COPIES = 16
BANDWIDTH = 0.3
"""Each draw is smeared over so many places, by so many standard deviations, before an interval is
read off: the shortest one of bare draws lies where they happen to be dense."""

LEAST_LEFT = 0.1
"""Least share of the information that is taken to be left without a block."""

MASS = 0.94
"""Of the interval of highest density."""


@dataclass(frozen=True)
class Estimate:
    """A parameter's posterior in a few numbers.

    Attributes:
        mean: Mean, in ``unit``.
        sd: Standard deviation.
        hdi_94: The shortest interval that holds 94 %.
        unit: Its unit.
    """

    mean: float
    sd: float
    hdi_94: tuple[float, float]
    unit: str

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values; what is not finite is null."""
        mean, sd, low, high = (
            value if math.isfinite(value) else None for value in (self.mean, self.sd, *self.hdi_94)
        )
        return {"mean": mean, "sd": sd, "hdi_94": [low, high], "unit": self.unit}


@dataclass(frozen=True)
class Draws:
    """Weighted draws of a posterior.

    Attributes:
        z: Reference coordinates, ``(n, d)``.
        weights: Their weights, ``(n,)``, one in all.
    """

    z: Tensor
    weights: Tensor

    def smoothed(self) -> "Draws":
        """Returns draws with smooth marginals of the same mean and variance (West 1993)."""
        mean = self.weights @ self.z
        sd = (self.weights @ (self.z - mean).square()).sqrt()
        places = torch.special.ndtri((torch.arange(COPIES).double() + 0.5) / COPIES)
        shrunk = mean + (1.0 - BANDWIDTH**2) ** 0.5 * (self.z - mean)
        smeared = shrunk[:, None] + BANDWIDTH * (places / places.std())[:, None] * sd
        return Draws(smeared.flatten(0, 1), self.weights.repeat_interleave(COPIES) / COPIES)

    def resampled(self, num: int) -> Tensor:
        """Returns draws of equal weight, ``(num, d)``, chosen from torch's global stream."""
        return self.z[systematic(self.weights.log(), num)]


def posterior_draws(hypothesis: Hypothesis, *, seed: int, num: int = NUM_PROPOSALS) -> Draws:
    """Returns draws of the posterior along the recording.

    Importance sampling, tempered where hardly any draw would count (Koblents & Míguez 2015). What
    the misfit adds to the parabola counts by as much as the robust covariance is wider than that
    of independent readings.

    Args:
        hypothesis: The fitted model.
        seed: Seed of the draws.
        num: How many, a power of two.
    """
    projection, centre = Projection(hypothesis), hypothesis.fit.z
    covariance = _robust_covariance(projection)
    sobol = torch.quasirandom.SobolEngine(len(centre), scramble=True, seed=seed)
    even = sobol.draw(num, dtype=torch.float64).clamp(1e-6, 1.0 - 1e-6)
    normal = torch.special.ndtri(even)
    # Fits go no further either, and beyond a prior's tail is infinity.
    z = centre + normal @ torch.linalg.cholesky(covariance).mT
    z = z.clamp(-MAX_COORDINATE, MAX_COORDINATE)
    moved = z - centre
    curvature = projection.parameter_information_by_segment.sum(0)
    parabola = projection.misfit + torch.einsum("ni,ij,nj->n", moved, curvature, moved)
    beyond = projection.misfit_at(z) - parabola
    share = min(1.0, len(centre) / float((curvature * covariance).sum().clamp_min(1e-12)))
    log_weights = (-0.5 * share * beyond).nan_to_num(-math.inf, -math.inf, -math.inf)
    exponent = longest_step(log_weights, 1.0, LEAST_EFFECTIVE)
    return Draws(z, (exponent * log_weights).softmax(0))


def _robust_covariance(projection: Projection) -> Tensor:
    """Returns the covariance of the posterior's normal approximation, ``(d, d)``.

    The robust one, H⁻¹ V H⁻¹ with V from how the blocks' scores scatter (Huber
    1967; White 1982; Müller 2013 for posteriors), which holds when readings within a block are
    correlated or the scale is wrong. Each block's score is what it would be had the block not been
    fitted (the jackknife, CR3 of Bell & McCaffrey 2002): few blocks may carry most of what is
    known. No parameter is taken to be surer than Laplace's approximation has it.
    """
    information = projection.parameter_information
    d = len(information)
    eye = torch.eye(d, dtype=torch.float64)
    scores = block_sums(projection.parameter_scores)
    parts = block_sums(projection.parameter_information_by_segment.flatten(1)).unflatten(1, (d, d))
    inverse = torch.linalg.inv(information)
    left = eye - parts @ inverse
    # A block that alone determines a direction cannot be left out of it.
    values, vectors = torch.linalg.eig(left)
    values = torch.complex(values.real.clamp_min(LEAST_LEFT), values.imag)
    freed = vectors @ (
        torch.linalg.solve(vectors, scores[..., None].to(vectors)) / values[..., None]
    )
    scatter = freed.real[..., 0].mT @ freed.real[..., 0]
    robust = inverse @ (scatter + eye) @ inverse
    wider = (inverse.diagonal() / robust.diagonal()).clamp_min(1.0).sqrt()
    covariance = wider[:, None] * robust * wider
    return 0.5 * (covariance + covariance.mT) + 1e-12 * eye


def estimates(
    hypothesis: Hypothesis, units: Mapping[str, str], *, seed: int
) -> dict[str, Estimate]:
    """Returns every scalar parameter's estimate, by site.

    Args:
        hypothesis: The fitted model.
        units: The parameters' units.
        seed: Seed of the draws.
    """
    own_seed = derived_seed(seed, "discovery", "estimates")
    draws = posterior_draws(hypothesis, seed=own_seed).smoothed()
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
    """Returns the ends of the shortest interval of the mass."""
    ordered, order = values.sort()
    # Each draw stands for the mass on both sides of it.
    mass = weights[order].cumsum(0) - 0.5 * weights[order]
    end = torch.searchsorted(mass, mass + MASS)
    inside = end < len(ordered)
    widths = torch.where(inside, ordered[end.clamp_max(len(ordered) - 1)] - ordered, math.inf)
    start = int(widths.argmin())
    if not bool(inside[start]):
        return float(ordered[0]), float(ordered[-1])
    return float(ordered[start]), float(ordered[end[start]])
