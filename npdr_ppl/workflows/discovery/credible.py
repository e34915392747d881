"""How sure the parameters of a hypothesis are."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.inference.gaussian_mixture import GaussianMixture
from npdr_ppl.randomness import seeded
from npdr_ppl.workflows.discovery.chance import block_sums
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis
from npdr_ppl.workflows.discovery.projection import Projection
from npdr_ppl.workflows.segment_fit import MAX_COORDINATE

__all__ = ["Estimate", "estimates", "parameter_density"]

NUM_DRAWS = 4000

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


def parameter_density(hypothesis: Hypothesis) -> GaussianMixture:
    """Returns the normal approximation of the posterior, in reference coordinates.

    Its covariance is the robust one, H⁻¹ V H⁻¹ with V from how the blocks' scores scatter (Huber
    1967; White 1982; Müller 2013 for posteriors), which holds when readings within a block are
    correlated or the scale is wrong. Each block's score is what it would be had the block not been
    fitted (the jackknife, CR3 of Bell & McCaffrey 2002): few blocks may carry most of what is
    known. No parameter is taken to be surer than Laplace's approximation has it.

    Args:
        hypothesis: The fitted model.
    """
    projection = Projection(hypothesis)
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
    one = torch.ones(1, dtype=torch.float64)
    covariance = 0.5 * (covariance + covariance.mT) + 1e-12 * eye
    return GaussianMixture.from_moments(one, hypothesis.fit.z[None], covariance[None])


def estimates(
    hypothesis: Hypothesis, units: Mapping[str, str], *, seed: int
) -> dict[str, Estimate]:
    """Returns every scalar parameter's estimate, by site.

    Args:
        hypothesis: The fitted model.
        units: The parameters' units.
        seed: Seed of the draws.
    """
    with seeded(seed, "discovery", "estimates"):
        z = parameter_density(hypothesis).sample(NUM_DRAWS).double()
    # Fits go no further either, and beyond a prior's tail is infinity.
    z = z.clamp(-MAX_COORDINATE, MAX_COORDINATE)
    values = hypothesis.segments.prior.to_parameters(z)
    return {
        name: Estimate(
            float(value.mean()), float(value.std()), _shortest(value), units.get(name, "")
        )
        for name, value in values.items()
        if value[0].numel() == 1
    }


def _shortest(draws: Tensor) -> tuple[float, float]:
    values = np.sort(draws.double().flatten().numpy())
    width = int(np.ceil(MASS * len(values)))
    start = int(np.argmin(values[width - 1 :] - values[: len(values) - width + 1]))
    return float(values[start]), float(values[start + width - 1])
