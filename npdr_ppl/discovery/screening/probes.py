"""What is simulated of each candidate effect: its shapes and its sizes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.discovery.screening.settings import SENSITIVITY
from npdr_ppl.language.effects import ActionEffect, Effect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.reference import quantile
from npdr_ppl.language.simulator import Simulator

__all__ = ["Probe", "needs_size", "probe_of"]


@dataclass(frozen=True)
class Probe:
    """An effect to be simulated in several shapes and sizes.

    Attributes:
        effect: The effect.
        priors: Its priors, by parameter.
        cases: Values of its parameters at size one, whether they are hinted, and the size.
        strengths: Names of the parameters that scale it.
        nominal: Their values at zero strength in each case; for a limit, the largest command.
        runs: Parameters of each simulation: one per case and strength, the others at zero
            strength.
    """

    effect: Effect
    priors: Mapping[str, Distribution]
    cases: list[tuple[dict[str, float], bool, float]]
    strengths: tuple[str, ...]
    nominal: list[Tensor]
    runs: list[dict[str, float]]

    def at(self, cases: Sequence[int]) -> "Probe":
        """Returns the probe with some of its cases only."""
        width = len(self.strengths)
        return replace(
            self,
            cases=[self.cases[k] for k in cases],
            nominal=[self.nominal[k] for k in cases],
            runs=[run for k in cases for run in self.runs[k * width : (k + 1) * width]],
        )


def probe_of(
    effect: Effect, inputs: Inputs, simulator: Simulator, hint: Mapping[str, float] | None
) -> Probe:
    """Returns what is simulated of an effect.

    Args:
        effect: The effect.
        inputs: The recording's inputs.
        simulator: The simulator that it would be attached to.
        hint: Values of its parameters for another shape to try.
    """
    port = simulator.port(effect.port)
    priors = effect.priors(port)
    probe = effect.probe(port)
    strengths = tuple(p.name for p in effect.strengths)
    resting = {p.name: p.nominal for p in effect.parameters}
    peaks = _peaks(effect, inputs)
    probe |= {name: SENSITIVITY.first_limit * peak for name, peak in peaks.items()}
    shapes = [(shape, False) for shape in _shapes(effect, priors, strengths)]
    if hint:
        shapes.append(({**shapes[0][0], **hint}, True))
    sizes: tuple[float, ...] = (SENSITIVITY.smooth_size,)
    if needs_size(effect, strengths):
        sizes = SENSITIVITY.sizes
        if all(_may_be_negative(priors[n], resting[n]) for n in strengths):
            sizes = *sizes, *(-size for size in sizes)
    if effect.is_resonant:
        shapes, sizes = shapes[:1], SENSITIVITY.resonant_sizes
    limits = [n for n in strengths if math.isinf(resting[n]) and n not in peaks]
    if limits:
        # How much of a motion a limit cuts off is not known, so several values are tried.
        shapes, sizes = _limit_shapes(shapes[0][0], limits, priors), (1.0,)
    cases = [
        ({**probe, **shape}, is_hinted, size)
        for shape, is_hinted in shapes
        # Only the whole step is tried: half of it rounds to other values.
        for size in ((1.0,) if is_hinted and effect.rounds else sizes)
    ]
    nominal = [
        torch.tensor([_resting(resting[n], values[n]) for n in strengths]).double()
        for values, _, _ in cases
    ]
    runs = [
        _switched_on(values, size, on, zero[k], resting, strengths)
        for (values, _, size), zero in zip(cases, nominal, strict=True)
        for k, on in enumerate(strengths)
    ]
    return Probe(effect, priors, cases, strengths, nominal, runs)


def _may_be_negative(prior: Distribution, zero: float) -> bool:
    """Returns whether a strength can be on either side of zero strength."""
    lower = getattr(prior.support, "lower_bound", -math.inf)
    return math.isfinite(zero) and float(lower) < zero


def _switched_on(
    values: Mapping[str, float],
    size: float,
    on: str,
    nominal: Tensor,
    resting: Mapping[str, float],
    strengths: tuple[str, ...],
) -> dict[str, float]:
    """Returns an effect's parameters with one strength at a size and the others at zero."""
    rest = {name: resting[name] if name in strengths else value for name, value in values.items()}
    zero = float(nominal)
    return rest | {on: size * (values[on] - zero) + zero}


def _shapes(
    effect: Effect, priors: Mapping[str, Distribution], strengths: tuple[str, ...]
) -> list[dict[str, float]]:
    """Returns values of the shape parameters, the nominal ones first."""
    varied = [p for p in effect.parameters if p.name not in strengths]
    shapes: list[dict[str, float]] = [{p.name: p.nominal for p in varied}]
    for parameter in varied:
        for share in SENSITIVITY.shape_quantiles[1:]:
            value = float(quantile(priors[parameter.name], torch.tensor(share)))
            shapes.append({**shapes[0], parameter.name: value})
    return shapes[: SENSITIVITY.most_shapes]


def needs_size(effect: Effect, strengths: tuple[str, ...]) -> bool:
    """Returns whether small sizes of an effect do not tell what a typical size changes.

    Example: a lag far below the sampling time changes no sample.
    """
    units = {p.name: p.unit for p in effect.parameters}
    return not effect.is_smooth or any(units[name] == "s" for name in strengths)


def _peaks(effect: Effect, inputs: Inputs) -> dict[str, float]:
    """Returns the greatest recorded values of what an effect on one command limits."""
    if not isinstance(effect, ActionEffect) or effect.port not in inputs.action_names:
        return {}
    commands = inputs.actions[..., inputs.action_names.index(effect.port)]
    return effect.peaks(commands, inputs.time_step)


def _limit_shapes(
    values: Mapping[str, float], limits: list[str], priors: Mapping[str, Distribution]
) -> list[tuple[dict[str, float], bool]]:
    """Returns values of limits at several quantiles of their priors."""
    return [
        ({**values, **{n: float(quantile(priors[n], torch.tensor(q))) for n in limits}}, False)
        for q in SENSITIVITY.limit_quantiles
    ]


def _resting(nominal: float, probe: float) -> float:
    """Returns zero strength as a finite number; for a limit, the largest command."""
    return nominal if math.isfinite(nominal) else probe / SENSITIVITY.first_limit
