"""Learns the laws that a model misses, port by port, and fits them by simulation.

In every round, the formulas at each port are compared by linear least squares. The best one at
each of a few ports is fitted by simulation, together with all parameters, and the closest fit
stays. The next round begins from there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.assumptions import Assumptions
from npdr_ppl.discovery.learning.formulas import (
    NO_ASSUMPTIONS,
    PortFormulas,
    effects_of,
    formulas_by_port,
    law_of,
)
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.regression import Formula, simplest
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.search.rounds import explained
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.models.effects import candidate_effects

__all__ = ["LearnedModel", "learned_model", "with_values"]


@dataclass(frozen=True)
class LearnedModel:
    """A model with learned laws.

    Attributes:
        start: The fitted model without the laws.
        hypothesis: The model with the laws, fitted by simulation.
        laws: The laws, with their fitted constants.
        ports: The formulas at each port for the model without the laws, the best port first.
    """

    start: Hypothesis
    hypothesis: Hypothesis
    laws: tuple[Law, ...]
    ports: tuple[PortFormulas, ...]

    def complexity(self) -> float:
        """Returns what its laws and the effects beside them cost, in units of the misfit."""
        beside = sum(len(effect.parameters) for effect in self.start.effects)
        own = sum(term.cost for law in self.laws for term in law.terms)
        return max(port.penalty for port in self.ports) * (own + beside)


def learned_model(
    trials: Trials,
    start: Hypothesis,
    report: Callable[[str], None] = lambda _: None,
    *,
    assumptions: Assumptions = NO_ASSUMPTIONS,
) -> LearnedModel | None:
    """Learns the laws that a fitted model misses.

    Args:
        trials: Fits of the model.
        start: The fitted model.
        report: Called with a sentence about each step.
        assumptions: What is known about the laws.

    Returns:
        ``None`` if no law predicts parts of the recording better than the model without one.
    """
    current, laws = start, ()
    # An added effect may come from an earlier search, and have the name of the port as well.
    others = (*start.simulator.effects, *candidate_effects(start.simulator))
    ids = {effect.id for effect in others}
    first: list[PortFormulas] = []
    for _ in range(LEARNING.most_laws):
        report("comparing formulas at every port")
        ports = formulas_by_port(current, assumptions)
        first = first or ports
        chosen = [(port, simplest(port.front)) for port in ports]
        chosen = [(port, formula) for port, formula in chosen if _improves(port, formula)]
        chosen.sort(key=lambda pair: pair[1].error)
        tried: list[tuple[Hypothesis, tuple[Law, ...]]] = []
        for port, formula in chosen[: LEARNING.num_fitted]:
            new = law_of(port, formula).apart_from(ids)
            report(f"fitting {new.formula} at {new.port.name}")
            together = _together(laws, new)
            effects, values = effects_of(together)
            given = {k: v for k, v in values.items() if k not in current.parameters}
            found = trials.refitted(current, (*start.effects, *effects), start=given)
            if found is not None:
                tried.append((found, together))
        if not tried:
            break
        best = closest([h for h, _ in tried])
        if explained(current, best) <= VERDICT.minor_share * explained(start, best):
            break
        current = best
        laws = next(together for h, together in tried if h is best)
    if not laws:
        return None
    fitted = tuple(with_values(law, current.parameters) for law in laws)
    return LearnedModel(start, current, fitted, tuple(first))


def _improves(port: PortFormulas, formula: Formula) -> bool:
    """Returns whether a formula predicts the folds better than chance does."""
    less = port.front[0].error - formula.error
    return bool(formula.terms) and less > port.penalty


def _together(laws: Sequence[Law], new: Law) -> tuple[Law, ...]:
    """Returns the laws with a new one, which is added to one at the same port."""
    result = [law for law in laws if law.port.name != new.port.name]
    for law in laws:
        if law.port.name == new.port.name:
            known = {term.key for term in law.terms}
            kept = [k for k, term in enumerate(new.terms) if term.key not in known]
            widths = [len(term.columns) for term in new.terms]
            starts = [sum(widths[:k]) for k in range(len(widths))]
            new = replace(
                law,
                terms=(*law.terms, *(new.terms[k] for k in kept)),
                coefficients=(*law.coefficients, *_parts(new.coefficients, starts, widths, kept)),
                spreads=(*law.spreads, *_parts(new.spreads, starts, widths, kept)),
            )
    return (*result, new)


def _parts(
    values: Sequence[float], starts: Sequence[int], widths: Sequence[int], kept: Sequence[int]
) -> tuple[float, ...]:
    return tuple(v for k in kept for v in values[starts[k] : starts[k] + widths[k]])


def with_values(law: Law, parameters: Mapping[str, Tensor]) -> Law:
    """Returns a law with other constants.

    Args:
        law: The law.
        parameters: The constants, by site.
    """
    values = [
        float(parameters[f"{law.port.name}.{law.id}.{constant.name}"])
        for constant in law.constants
    ]
    num, terms = len(law.coefficients), []
    shapes = iter(values[num:])
    for term in law.terms:
        own = tuple(replace(shape, value=next(shapes)) for shape in term.shapes)
        terms.append(replace(term, shapes=own))
    # Priors for those who take the law to another rig: it may be twice as strong there.
    spreads = tuple(max(2.0 * abs(value), 1e-12) for value in values[:num])
    return replace(law, terms=tuple(terms), coefficients=tuple(values[:num]), spreads=spreads)
