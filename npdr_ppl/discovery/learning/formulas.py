"""The formulas at every port, and the laws and effects that they become."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.assumptions import Assumptions
from npdr_ppl.discovery.learning.effect_source import module_source
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.recorded_motion import PortMotion, motion_at_ports
from npdr_ppl.discovery.learning.regression import (
    Formula,
    NormalEquations,
    PortProducts,
    pareto_front,
)
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.learning.term import Term
from npdr_ppl.discovery.learning.terms import terms_at, with_harmonics
from npdr_ppl.discovery.learning.terms_with_memory import series_at
from npdr_ppl.discovery.revised_model import LEARNED
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect

__all__ = ["NO_ASSUMPTIONS", "PortFormulas", "effects_of", "formulas_by_port", "law_of"]


NO_ASSUMPTIONS = Assumptions()
"""Any law."""


@dataclass(frozen=True)
class PortFormulas:
    """The formulas at one port.

    Attributes:
        products: Products of the responses at the port.
        terms: The terms that were compared.
        num_others: Number of terms of the series that were examined and are not among the terms.
        weights: Weights of the responses in each term's columns, ``(S, P, k)`` each; ``None`` if
            they follow from the motion.
        penalty: Reduction of the misfit that the best of so many spurious coefficients brings.
        front: The best formula of each number of terms.
    """

    products: PortProducts
    terms: list[Term]
    num_others: int
    weights: list[Tensor] | None
    penalty: float
    front: list[Formula]

    @property
    def motion(self) -> PortMotion:
        """The motion at the port."""
        return self.products.motion

    def equations(self) -> NormalEquations:
        """Returns the products of the terms, which are not kept: a joint has 100 MB of them."""
        found = _equations(self.products, self.terms, self.weights)
        return replace(found, num_others=self.num_others)


def _equations(
    products: PortProducts, terms: Sequence[Term], weights: Sequence[Tensor] | None = None
) -> NormalEquations:
    if weights is None:
        motion = products.motion
        weights = [motion.columns(term.values(motion)) for term in terms]
    return products.equations(terms, weights)


def formulas_by_port(
    hypothesis: Hypothesis, assumptions: Assumptions = NO_ASSUMPTIONS
) -> list[PortFormulas]:
    """Returns the formulas at each port, the port with the least error first.

    Args:
        hypothesis: The fitted model.
        assumptions: What is known about the law.
    """
    projection = Projection(hypothesis)
    result = []
    for motion in motion_at_ports(hypothesis):
        terms = assumptions.applied_to(terms_at(motion), motion)
        if not terms:
            continue
        if motion.responses is None:
            known = _sensor_responses(hypothesis, motion, terms)
            if known is None:
                continue
            responses, weights = known
        else:
            responses, weights = motion.responses, None
        products, num_others = PortProducts(projection, motion, responses), 0
        series = assumptions.applied_to(series_at(motion), motion)
        if series:
            found = _strongest(products, series)
            terms, num_others = [*terms, *found], len(series) - len(found)
        equations = replace(_equations(products, terms, weights), num_others=num_others)
        penalty, front = equations.penalty, equations.front()
        del equations
        if motion.responses is not None:
            front += _with_harmonics(products, terms, front)
            front = [_refined(products, formula) for formula in pareto_front(front)]
        front = pareto_front([each for each in front if assumptions.agrees(each, motion)])
        result.append(PortFormulas(products, terms, num_others, weights, penalty, front))
    return sorted(result, key=lambda port: min(f.error for f in port.front))


def _strongest(products: PortProducts, every: Sequence[Term]) -> list[Term]:
    """Returns those of a series of terms that are local maxima of what a term alone explains.

    Args:
        products: Products of the responses at the port.
        every: Terms with as many columns, in the order of their constant.
    """
    gains = [
        _equations(products, every[k : k + LEARNING.num_waves]).gains_alone()
        for k in range(0, len(every), LEARNING.num_waves)
    ]
    gain = torch.cat(gains)
    if len(gain) < len(every):  # some do not change anything, at a command that is constant
        return []
    end = torch.full((1,), -torch.inf, dtype=gain.dtype)
    padded = torch.cat((end, gain, end))
    is_peak = (gain >= padded[:-2]) & (gain >= padded[2:])
    order = gain.where(is_peak, -torch.inf).argsort(descending=True).tolist()
    return [every[k] for k in order[: LEARNING.num_peaks] if bool(is_peak[k])]


def _refined(products: PortProducts, formula: Formula) -> Formula:
    """Returns a formula with shape constants between those that were tried.

    Each constant is varied in smaller and smaller steps, and the others are kept.
    """
    best = formula
    step = LEARNING.shape_step
    while step > LEARNING.finest_shape_step:
        before = best
        for index, term in enumerate(formula.terms):
            for place in range(len(term.shapes)):
                for factor in (1.0 - step, 1.0 + step):
                    terms = list(best.terms)
                    shapes = list(terms[index].shapes)
                    shapes[place] = replace(shapes[place], value=factor * shapes[place].value)
                    terms[index] = replace(terms[index], shapes=tuple(shapes))
                    equations = _equations(products, terms)
                    if len(equations.terms) == len(terms):
                        found = equations.all_terms
                        if found.misfit < best.misfit:
                            best = replace(found, errors=formula.errors)
        if best is before:
            step *= 0.5
    return best


def _with_harmonics(
    products: PortProducts, terms: Sequence[Term], front: Sequence[Formula]
) -> list[Formula]:
    """Returns formulas with the harmonics of the waves that were found; empty without waves."""
    found = list({term.key: term for formula in front for term in formula.terms}.values())
    waves = [more for term in found if (more := with_harmonics(term)) is not None]
    if not waves:
        return []
    chosen = [term for term in terms if not term.shapes and term not in found]
    chosen += [*found, *waves]
    return _equations(products, chosen).front()[1:]


def _sensor_responses(
    hypothesis: Hypothesis, motion: PortMotion, terms: Sequence[Term]
) -> tuple[Tensor, list[Tensor]] | None:
    """Returns the change by each column of errors of a sensor, simulated, and which is whose.

    An error of a sensor also changes the state at which a segment begins.

    Args:
        hypothesis: The fitted model.
        motion: The motion at the sensor.
        terms: The terms.
    """
    segments, fit = hypothesis.segments, hypothesis.fit
    ones = (1.0,) * sum(len(term.columns) for term in terms)
    ranges = {name: (0.0, 1.0) for name in motion.values}
    every = Law(motion.port, tuple(terms), ones, ones, ranges, motion.units)
    every = every.apart_from({effect.id for effect in segments.simulator.effects})
    (effect,), start = effects_of([every])
    sizes = torch.cat([term.values(motion).square().mean((0, 1)).sqrt() for term in terms])
    num = len(sizes)
    steps = LEARNING.pulse_height * motion.port.rated / sizes.clamp_min(1e-12)
    # One column at a time, and none in the last run.
    sites = [f"{effect.name}.c{k + 1}" for k in range(num)]
    batch = dict(zip(sites, torch.cat((steps.diag(), torch.zeros(num, 1)), dim=1), strict=True))
    batch |= {name: value.expand(num + 1) for name, value in start.items() if name not in batch}
    known = segments.black_box(fit.z[None]).parameters
    runs: list[Tensor] = []
    try:
        simulator = segments.simulator.with_effects(effect)
        for part in torch.arange(num + 1).split(segments.draws_per_chunk):
            own = {name: value[part] for name, value in batch.items()}
            offsets = fit.offsets[None].expand(len(part), -1, -1)
            readings = segments.run(simulator, {**known, **own}, offsets)
            runs += segments.whitened(readings, fit.scale).unbind(0)
    except (NpdrError, NotImplementedError):
        return None
    change = torch.stack([run - runs[-1] for run in runs[:-1]], dim=-1) / steps
    if not bool(change.isfinite().all()):
        return None
    eye = torch.eye(num, dtype=torch.float64).expand(change.shape[0], num, num)
    widths = [len(term.columns) for term in terms]
    return change, list(eye.split(widths, dim=-1))


def law_of(port: PortFormulas, formula: Formula) -> Law:
    """Returns a formula as a law."""
    motion, spreads = port.motion, []
    for term in formula.terms:
        size = term.values(motion).square().mean((0, 1)).sqrt()
        spreads += (LEARNING.prior_spread * motion.port.rated / size).tolist()
    return Law(
        motion.port,
        formula.terms,
        tuple(formula.coefficients.tolist()),
        tuple(spreads),
        {name: (float(x.min()), float(x.max())) for name, x in motion.values.items()},
        motion.units,
        others=motion.others,
    )


def effects_of(laws: Sequence[Law]) -> tuple[tuple[Effect, ...], dict[str, torch.Tensor]]:
    """Returns the effects with these laws, and their parameters by site."""
    source = module_source(laws, "Not yet fitted.")
    space: dict[str, object] = {"__name__": LEARNED}
    exec(compile(source, "learned_effect.py", "exec"), space)
    effects, start = [], {}
    for law in laws:
        effect = space[law.class_name](law.port.name)  # pyright: ignore[reportCallIssue]
        effects.append(effect)
        for constant in law.constants:
            start[f"{effect.name}.{constant.name}"] = torch.tensor(
                constant.value, dtype=torch.float64
            )
    return tuple(effects), start
