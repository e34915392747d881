"""The learned laws, what they depend on, and whether they are offered."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.assumptions import Assumptions
from npdr_ppl.discovery.learning.curves import Curve, curves
from npdr_ppl.discovery.learning.effect_source import module_source
from npdr_ppl.discovery.learning.formulas import NO_ASSUMPTIONS, PortFormulas
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.learn import LearnedModel, learned_model, with_values
from npdr_ppl.discovery.learning.proof import Check, checks
from npdr_ppl.discovery.learning.settings import LEARNING
from npdr_ppl.discovery.learning.term import HISTORY
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.sensitivities import sensitivities
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.search.rounds import explained
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.language.effects import Effect
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts

__all__ = ["Learned", "Likeness", "learn"]


@dataclass(frozen=True)
class Likeness:
    """The effect of the catalogue that is most similar to a law.

    Attributes:
        effect: Its name.
        correlation: Correlation of what both change in the measurements, once all parameters are
            refitted.
    """

    effect: str
    correlation: float


@dataclass(frozen=True)
class Learned:
    """The result of learning.

    Attributes:
        model: The model with the laws.
        checks: Misfits of measurements that were not fitted.
        depends_on: For each of the best ports, by how much the explained misfit shrinks without
            each variable, as a share.
        alike: For each law's port, the most similar effect of the catalogue.
        curves: Each law over each of its variables.
        reason: Why the laws are offered or not, in a sentence.
        is_offered: Whether the laws help wherever they were checked.
    """

    model: LearnedModel
    checks: tuple[Check, ...]
    depends_on: Mapping[str, Mapping[str, float]]
    alike: Mapping[str, Likeness]
    curves: tuple[Curve, ...]
    reason: str
    is_offered: bool

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The learned effects."""
        return self.model.hypothesis.effects[len(self.model.start.effects) :]

    def withdrawn(self, reason: str) -> "Learned":
        """Returns the result with laws that are not offered.

        Args:
            reason: Why they are not.
        """
        return replace(self, reason=reason, is_offered=False)

    def fitted_along(self, start: Hypothesis, trials: Trials) -> "Learned":
        """Returns the result with the model and its laws fitted along other segments.

        Checks and curves stay those of the segments along which the laws were learned.

        Args:
            start: The model without the laws, fitted along those segments.
            trials: Fits of the model along them.
        """
        model = self.model
        known = model.hypothesis.parameters
        again = trials.refitted(start, model.hypothesis.effects, start=known)
        if again is None or explained(start, again) <= 0.0:
            return self.withdrawn(f"{self.reason} But it explains nothing of longer segments.")
        laws = tuple(with_values(law, again.parameters) for law in model.laws)
        model = replace(model, start=start, hypothesis=again, laws=laws)
        return replace(self, model=model, reason=_reason(laws, self.checks))

    def source(self, about: str = "") -> str:
        """Returns the source of a file with the learned effects.

        Args:
            about: Where they come from, in sentences.
        """
        lines = [about] if about else []
        lines += [f"{c.where}: misfit {c.before:.3g} → {c.after:.3g}." for c in self.checks]
        lines += [
            f"At {port}, {like.effect} is most similar: correlation {like.correlation:.2f}."
            for port, like in self.alike.items()
        ]
        return module_source(self.model.laws, "\n".join(lines))

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return {
            "offered": self.is_offered,
            "reason": self.reason,
            "laws": [_law(law) for law in self.model.laws],
            "beside": [effect.name for effect in self.model.start.effects],
            "checks": [check.to_dict() for check in self.checks],
            "depends_on": {port: dict(shares) for port, shares in self.depends_on.items()},
            "alike": {
                port: {"effect": like.effect, "correlation": like.correlation}
                for port, like in self.alike.items()
            },
            "curves": [curve.to_dict() for curve in self.curves],
            "ports": [_front(port) for port in self.model.ports],
        }


def _law(law: Law) -> dict[str, Any]:
    return {
        "port": law.port.name,
        "effect": law.id,
        "class": law.class_name,
        "unit": law.port.unit,
        "formula": law.formula,
        "with_numbers": law.formula_with_numbers,
        "letters": law.letters,
        "constants": {c.name: {"value": c.value, "unit": c.unit} for c in law.constants},
        "ranges": {name: list(law.ranges[name]) for name in sorted(law.uses)},
    }


def _front(port: PortFormulas) -> dict[str, Any]:
    return {
        "port": port.motion.port.name,
        "formulas": [
            {
                "terms": [text for term in formula.terms for text in _texts(term)],
                "cost": formula.cost,
                "error": formula.error,
            }
            for formula in port.front
        ],
    }


def _texts(term: Any) -> tuple[str, ...]:
    return (term.key,) if term.is_spline else term.formulas


def learn(
    trials: Trials,
    starts: Sequence[Hypothesis],
    candidates: tuple[Effect, ...],
    *,
    holdout: Rollouts | None = None,
    options: DataOptions | None = None,
    assumptions: Assumptions = NO_ASSUMPTIONS,
    report: Callable[[str], None] = lambda _: None,
) -> Learned | None:
    """Learns the laws that a model misses, and checks them.

    Args:
        trials: Fits of the model.
        starts: Fitted models from which to begin: the original one, or with effects of the
            catalogue. The closest one is taken, with a penalty for its complexity.
        candidates: Effects to compare the laws with.
        holdout: A held-out recording, which is not used to choose.
        options: How the held-out recording is cut into segments.
        assumptions: What is known about the laws.
        report: Called with a sentence about each step.
    """
    tried = [learned_model(trials, start, report, assumptions=assumptions) for start in starts]
    found = [model for model in tried if model is not None]
    if not found:
        return None
    scale = closest([model.hypothesis for model in found]).fit.scale

    def cost(model: LearnedModel) -> float:
        return 2.0 * float(model.hypothesis.losses(scale).sum()) + model.complexity()

    model = min(found, key=cost)
    report("fitting each half")
    every = checks(model, holdout, options)
    return Learned(
        model,
        tuple(every),
        {port.motion.port.name: _dependence(port) for port in model.ports[: LEARNING.num_fitted]},
        _alike(model, candidates),
        tuple(curves(model)),
        _reason(model.laws, every),
        all(check.helps for check in every),
    )


def _reason(laws: Sequence[Law], every: Sequence[Check]) -> str:
    """Returns why laws are offered or not, in a sentence."""
    texts = ", ".join(f"{law.formula_with_numbers} at {law.port.name}" for law in laws)
    worse = [check for check in every if not check.helps]
    if worse:
        return f"The law {texts} does not help in {worse[0].where}."
    return f"Learned: {texts}."


def _dependence(port: PortFormulas) -> dict[str, float]:
    """Returns the share of the explained misfit that is lost without each variable."""
    none = port.front[0].error
    best = min(formula.error for formula in port.front)
    if none <= best:
        return {}
    result = {}
    equations = port.equations()
    own = {name: name for name in port.motion.values}
    for number, other in enumerate(port.motion.others, 1):
        own |= {f"q_{number}": f"q of {other}", f"v_{number}": f"v of {other}"}
    if any(term.memory is not None for term in port.terms):
        own[HISTORY] = HISTORY
    for variable, name in own.items():
        # Harmonics are only in the port's own formulas.
        without = [f for f in port.front if not any(t.depends_on(variable) for t in f.terms)]
        without += equations.without_terms(variable).front()
        lost = min(formula.error for formula in without) - best
        result[name] = min(1.0, max(0.0, lost / (none - best)))
    return dict(sorted(result.items(), key=lambda item: -item[1]))


def _alike(model: LearnedModel, candidates: tuple[Effect, ...]) -> dict[str, Likeness]:
    """Returns the effect of the catalogue that is most similar to each law."""
    projection = Projection(model.start)
    result = {}
    own = model.hypothesis.effects[len(model.start.effects) :]
    for law, effect in zip(model.laws, own, strict=True):
        there = tuple(e for e in candidates if e.port == law.port.name)
        change = _change(model, effect)
        if change is None or not there:
            continue
        target = projection.projected(change[..., None])[..., 0].flatten()
        best: Likeness | None = None
        for variant in sensitivities(model.start, there):
            columns = projection.projected(variant.change).flatten(0, 1)
            explained = columns @ _within(columns, target, variant.lower, variant.upper)
            size = float(explained.norm() * target.norm())
            likeness = float(explained @ target) / size if size > 0.0 else 0.0
            if best is None or likeness > best.correlation:
                best = Likeness(variant.effect.name, likeness)
        if best is not None:
            result[law.port.name] = best
    return result


def _within(columns: Tensor, target: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Returns coefficients within limits, ``(k,)``, by least squares.

    What is beyond a limit stays at it while the others are fitted again: friction does not push.

    Args:
        columns: The columns, ``(n, k)``.
        target: What they are fitted to, ``(n,)``.
        lower: Least coefficients, ``(k,)``.
        upper: Greatest coefficients, ``(k,)``.
    """
    solution = torch.zeros_like(lower)
    is_free = torch.ones_like(lower, dtype=torch.bool)
    while bool(is_free.any()):
        left = target - columns[:, ~is_free] @ solution[~is_free]
        found = torch.linalg.lstsq(columns[:, is_free], left[:, None], driver="gelsd").solution
        solution[is_free] = found[:, 0]
        limited = torch.minimum(torch.maximum(solution, lower), upper)
        is_beyond = is_free & (limited != solution)
        solution = limited
        if not bool(is_beyond.any()):
            break
        is_free &= ~is_beyond
    return solution


def _change(model: LearnedModel, effect: Effect) -> Tensor | None:
    """Returns the change of the whitened measurements by a learned effect, ``(S, N)``."""
    fitted = model.hypothesis
    segments, fit = fitted.segments, fitted.fit
    box = segments.black_box(fit.z[None])
    resting = {
        f"{effect.name}.{p.name}": torch.tensor([p.nominal], dtype=torch.float64)
        for p in effect.strengths
    }
    present = segments.run(box.simulator, box.parameters, fit.offsets[None])[0]
    absent = segments.run(box.simulator, {**box.parameters, **resting}, fit.offsets[None])[0]
    change = segments.whitened(present - absent, model.start.fit.scale)
    return change if bool(change.isfinite().all()) else None
