"""A learned law over each of its variables, beside the force estimated without a law."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.learn import LearnedModel, with_values
from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.screening.latent_force import Responses, latent_force
from npdr_ppl.discovery.screening.projection import Projection

__all__ = ["Curve", "curves", "law_along"]

BAND = 0.03, 0.97
"""Quantiles of the band of a law: the 94 % that all intervals have."""


@dataclass(frozen=True)
class Curve:
    """Means over the parts of the recording with similar values of a variable.

    Attributes:
        port: The law's port.
        unit: Unit of the law.
        variable: Symbol of the variable.
        variable_unit: Its unit.
        at: Mean of the variable in each of B bins.
        law: Mean of the law.
        band: Its 94 % band, ``(B, 2)``.
        estimate: Mean of the missing quantity, estimated without a law; empty at a sensor.
        error: Its standard error.
    """

    port: str
    unit: str
    variable: str
    variable_unit: str
    at: list[float]
    law: list[float]
    band: list[tuple[float, float]]
    estimate: list[float]
    error: list[float]

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        return dict(vars(self))


def curves(model: LearnedModel) -> list[Curve]:
    """Returns a curve for each variable of each law.

    Args:
        model: The model with the laws.
    """
    projection, result = Projection(model.start), []
    draws = _drawn_laws(model)
    for number, law in enumerate(model.laws):
        motion = next(p.motion for p in model.ports if p.motion.port.name == law.port.name)
        along = motion.parts(law_along(law, motion))
        drawn = torch.stack([motion.parts(law_along(d[number], motion)) for d in draws])
        estimate = error = None
        if motion.responses is not None:
            port = motion.port
            known = Responses(
                {port.name: motion.responses},
                {port.name: port.unit},
                {port.name: port.rated},
                {},
                {},
                motion.values["t"],
                torch.ones_like(motion.values["t"], dtype=torch.bool),
                model.start.segments.inputs.rollout,
            )
            (found,) = latent_force(projection, known)
            estimate, error = found.force, found.error
        for symbol in sorted(law.uses):
            values = motion.parts(motion.values[symbol])
            result.append(_curve(law, symbol, values, along, drawn, estimate, error))
    return result


def law_along(law: Law, motion: PortMotion) -> Tensor:
    """Returns a law at every step of the motion, ``(S, K)``."""
    flat = iter(law.coefficients)
    total = torch.zeros_like(motion.values["t"])
    for term in law.terms:
        for column in term.values(motion).unbind(-1):
            total = total + next(flat) * column
    return total


def _drawn_laws(model: LearnedModel) -> list[tuple[Law, ...]]:
    """Returns draws of the laws' constants, from the normal approximation at the fit."""
    fitted = model.hypothesis
    projection = Projection(fitted)
    precision = projection.parameter_information_by_segment.sum(0) * fitted.share
    precision = precision + torch.eye(len(precision), dtype=torch.float64)
    # Of the precision, not of its inverse, which rounding errors can make indefinite.
    factor = torch.linalg.cholesky(precision)
    generator = torch.Generator().manual_seed(0)
    shape = LEARNING.num_drawn_laws, len(precision)
    normal = torch.randn(shape, generator=generator, dtype=torch.float64)
    z = fitted.fit.z + torch.linalg.solve_triangular(factor.mT, normal.mT, upper=True).mT
    parameters = fitted.segments.prior.to_parameters(z)
    return [
        tuple(with_values(law, _one(parameters, k)) for law in model.laws) for k in range(len(z))
    ]


def _one(parameters: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
    return {name: value[index] for name, value in parameters.items()}


def _curve(
    law: Law,
    symbol: str,
    values: Tensor,
    along: Tensor,
    drawn: Tensor,
    estimate: Tensor | None,
    error: Tensor | None,
) -> Curve:
    order = values.flatten().argsort()
    bins = order.tensor_split(LEARNING.num_bins)
    low, high = BAND
    means = torch.stack([drawn.flatten(1)[:, b].mean(1) for b in bins], dim=1)
    edges = means.quantile(torch.tensor([low, high], dtype=torch.float64), dim=0)
    found: list[float] = []
    errors: list[float] = []
    if estimate is not None and error is not None:
        weight = error.flatten().square().reciprocal()
        for b in bins:
            total = weight[b].sum()
            found.append(float((weight[b] * estimate.flatten()[b]).sum() / total))
            errors.append(float(total.rsqrt()))
    return Curve(
        law.port.name,
        law.port.unit,
        symbol,
        law.units[symbol],
        [float(values.flatten()[b].mean()) for b in bins],
        [float(along.flatten()[b].mean()) for b in bins],
        [(float(a), float(b)) for a, b in edges.mT],
        found,
        errors,
    )
