"""Alternatives: other effects that could replace one effect, given all the others."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.generic_laws import PER_TURN
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.projection import Projection, loss_without
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.screening.settings import GENERIC_LAWS
from npdr_ppl.discovery.screening.variants import candidates_at, variants_of
from npdr_ppl.discovery.search.convergence import converge_likeliest
from npdr_ppl.discovery.search.evidence import closest, log_evidence, weigh
from npdr_ppl.discovery.search.parsimony import overlap
from npdr_ppl.discovery.search.repeatability import repetitions
from npdr_ppl.discovery.search.settings import EVIDENCE
from npdr_ppl.discovery.search.shortlist import enough_segments, fit_shortlist
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.language.effects import Effect
from npdr_ppl.memory import release_freed_memory
from npdr_ppl.preparation.closest_fit import part_of

__all__ = [
    "Added",
    "Alternatives",
    "find_alternatives",
    "log_prior",
    "probabilities",
    "tried_before",
    "weigh_alternatives",
    "with_simple_forms",
]

STRAIN = 0.02
"""Advantage that a law needs if it fits only with a shape parameter at its bound, as a share of
the misfit that it explains. There it is likely another law, and only the engine's solution
differs: bristles that hardly bend are dry friction."""


@dataclass(frozen=True)
class Added:
    """An effect in the search's result.

    Attributes:
        effect: The effect.
        place: Name of the effect that it replaced, or its own; the key of its trials.
        share: Share of the explained misfit that is lost without it.
        alternatives: Probability of each alternative, itself included, given all other effects,
            by name. That of the effect includes those of its forms, which are not among them.
        fitting: Names of the laws, its forms included, that fit equally well. The simplest law is
            the likeliest. But a law that contains it, as bristles contain dry friction, fits
            equally well if its further parameters have no visible influence.
        forms: Names of those in ``fitting`` that contain it and fit hardly better. The recording
            does not tell their shape.
        is_compared: Whether it was compared with alternatives; after a time limit it may not be.
    """

    effect: Effect
    place: str
    share: float
    alternatives: dict[str, float]
    fitting: tuple[str, ...] = ()
    forms: tuple[str, ...] = ()
    is_compared: bool = True

    @property
    def probability(self) -> float:
        """Probability of the effect, alone or within a law that contains it, given all others."""
        return self.alternatives[self.effect.name]


@dataclass(frozen=True)
class Alternatives:
    """The alternatives of an effect.

    Attributes:
        without: The model without the effect.
        with_it: The model with the effect, with the same initial states as the alternatives.
        others: The model with each alternative in the effect's place, by name.
        is_better: Whether the model with the effect fits better than when it was asked about.
    """

    without: Hypothesis
    with_it: Hypothesis
    others: dict[str, Hypothesis]
    is_better: bool = False


def find_alternatives(
    current: Hypothesis,
    effect: Effect,
    trials: Trials,
    options: DiscoveryOptions,
) -> Alternatives | None:
    """Fits the model with other effects in an effect's place.

    Where the effect explains very much, a part of the segments shows what could take its place.

    Args:
        current: The model with the effect.
        effect: The effect.
        trials: Fits the model.
        options: Options of the search.

    Returns:
        ``None`` if the model cannot be simulated without the effect.
    """
    without = trials.without(current, effect)
    if without is None:
        return None
    release_freed_memory()
    candidates = tuple(e for e in candidates_at(without, options) if e.name != effect.name)
    num_segments = without.segments.inputs.num_segments
    num = enough_segments(without, log_evidence(without, current))
    part = without
    if num < num_segments:
        part = without.along(part_of(without.segments, num))
    averaged = part.averaged()
    projection = Projection(averaged)
    ranking = screen(projection, variants_of(candidates, projection, responses(averaged)))
    ranking = [
        replace(candidate.without_change(), gain=candidate.gain * num_segments / num)
        for candidate in ranking
    ]
    release_freed_memory()
    tried = fit_shortlist(trials, without, ranking, offsets=current.fit.offsets)
    tried = converge_likeliest(trials, tried, without, done={effect.name: current})
    others = {name: h for name, h in tried.items() if name != effect.name}
    return Alternatives(without, current, trials.apart_from_waves_in_step(others))


def tried_before(
    current: Hypothesis,
    effect: Effect,
    seen: Sequence[tuple[Hypothesis, Mapping[str, Hypothesis]]],
) -> Alternatives | None:
    """Returns the alternatives of the last added effect, if they were fitted when it was added.

    Args:
        current: The model with the effect.
        effect: The effect.
        seen: Earlier hypotheses, each with its extensions by one candidate, by name.
    """
    rest = set(current.names) - {effect.name}
    for hypothesis, tried in seen:
        if set(hypothesis.names) == rest and effect.name in tried:
            others = {name: trial for name, trial in tried.items() if name != effect.name}
            return Alternatives(hypothesis, tried[effect.name], others)
    return None


def with_simple_forms(
    effect: Effect,
    alternatives: Alternatives,
    trials: Trials,
    stops: Callable[[], bool] = lambda: False,
) -> Alternatives:
    """Fits simple laws once more, from where a law that contains them fits better.

    Without the effects, the parameters may be far from where they are with one of them. The fit of
    a simple law may then end in a local minimum, and a law that contains it seems better only
    for this reason.

    Args:
        effect: The effect.
        alternatives: Its alternatives.
        trials: Fits the model.
        stops: Returns whether nothing more is to be fitted; called only if something is.
    """
    models = {effect.name: alternatives.with_it} | alternatives.others
    scale = closest(list(models.values())).fit.scale
    losses = {name: float(model.losses(scale).sum()) for name, model in models.items()}
    best = min(losses, key=lambda name: losses[name])
    law = next(e for e in models[best].effects if e.name == best)
    simple = [
        e
        for name, model in models.items()
        for e in model.effects
        if e.name == name
        and e.port == law.port
        and e.id in law.contains
        and models[best].share * (losses[name] - losses[best]) > EVIDENCE.indistinct_loss
    ]
    if not simple or stops():
        return alternatives
    others = tuple(e for e in models[best].effects if e.name != best)
    fitted = trials.each_refitted(models[best], [(*others, e) for e in simple])
    for e, found in zip(simple, fitted, strict=True):
        if found is not None and float(found.losses(scale).sum()) < losses[e.name]:
            models[e.name] = found
    with_it = models.pop(effect.name)
    is_better = with_it is not alternatives.with_it
    return Alternatives(alternatives.without, with_it, models, is_better)


def weigh_alternatives(
    base: Hypothesis,
    current: Hypothesis,
    effect: Effect,
    alternatives: Alternatives | None,
    *,
    is_approximate: bool = False,
) -> tuple[Hypothesis, Added]:
    """Computes the probabilities of the alternatives and chooses the likeliest.

    Args:
        base: The original model.
        current: The model with the effect.
        effect: The effect.
        alternatives: Its alternatives; ``None`` if it is not compared with any.
        is_approximate: Whether something remains that no law of the catalogue explains. A law
            that contains a simpler one must then explain clearly more than others.

    Returns:
        The model with the likeliest effect, and this effect.
    """
    if alternatives is None:
        share = _linear_share(base, current, effect)
        return current, Added(effect, effect.name, share, {effect.name: 1.0})
    without, trials = (
        alternatives.without,
        {effect.name: alternatives.with_it} | alternatives.others,
    )
    checked: set[str] = {effect.name}
    while True:
        weights = probabilities(trials, without, is_approximate)
        # Alternatives that the recording contradicts do not make the effect uncertain.
        asked = [
            name
            for name, probability in weights.items()
            if probability >= EVIDENCE.least_probability and name not in checked
        ]
        checked.update(asked)
        refuted = {name for name in asked if not _is_found_again(trials[name], name)}
        if not refuted:
            break
        trials = {name: trial for name, trial in trials.items() if name not in refuted}
    best = max(weights, key=lambda name: weights[name])
    swapped = trials[best]
    chosen = next(e for e in swapped.effects if e.name == best)
    scale = closest([base, swapped]).fit.scale
    whole, lost = (float((h.losses(scale) - swapped.losses(scale)).sum()) for h in (base, without))
    # Without it, the other effects can leave more than the original model does.
    share = min(1.0, max(0.0, lost) / max(whole, 1e-12))
    excess = _excess_losses(trials, best)
    fitting = tuple(name for name, e in excess.items() if e < EVIDENCE.indistinct_loss)
    forms = tuple(
        name
        for name in fitting
        if _contains(trials[name], name, chosen) and excess[name] > -EVIDENCE.indistinct_loss
    )
    weights[best] += sum(weights.pop(name) for name in forms)
    if best == effect.name and not alternatives.is_better:
        swapped = current
    return swapped, Added(chosen, effect.name, share, weights, fitting, forms)


def _linear_share(base: Hypothesis, current: Hypothesis, effect: Effect) -> float:
    """Returns the share of the explained misfit that is lost without an effect, to first order."""
    whole = float((base.losses(current.fit.scale) - current.losses(current.fit.scale)).sum())
    lost = loss_without(current, effect) / current.share if current.can_be_linearised else math.nan
    # If the model cannot be simulated without the effect, all is lost.
    return min(1.0, lost / max(whole, 1e-12)) if math.isfinite(lost) else 1.0


def probabilities(
    trials: Mapping[str, Hypothesis],
    without: Hypothesis,
    is_approximate: bool,
    granted: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Returns the probability of each candidate, by name.

    Args:
        trials: The model with each candidate, by the candidate's name.
        without: The model without the candidates.
        is_approximate: Whether something remains that no law of the catalogue explains.
        granted: Log density that is added to that of candidates, by name.
    """
    strains = _strains(trials, without, is_approximate)
    extra = [0.0 if granted is None else granted.get(name, 0.0) for name in trials]
    prior = [
        log_prior(trial) - strain + gain
        for trial, strain, gain in zip(trials.values(), strains, extra, strict=True)
    ]
    return dict(zip(trials, weigh(list(trials.values()), prior), strict=True))


def _is_found_again(trial: Hypothesis, name: str) -> bool:
    """Returns whether an effect of a model is found again in parts of the recording."""
    found = repetitions(trial) if trial.can_be_linearised else {}
    return name not in found or found[name].is_found_again


def log_prior(hypothesis: Hypothesis) -> float:
    """Returns the penalty for searching frequencies: all of them share one hypothesis's prior.

    The same holds for numbers of ripples, and for steps of commands.
    """
    return -sum(math.log(_num_tried(effect)) for effect in hypothesis.effects)


def _num_tried(effect: Effect) -> int:
    """Returns of how many values the recording chose one before the effect was fitted."""
    if effect.wave:
        return GENERIC_LAWS.num_frequencies
    if effect.has_ripples:
        return len(PER_TURN)
    return GENERIC_LAWS.num_roundings if effect.rounds else 1


def _excess_losses(trials: Mapping[str, Hypothesis], best: str) -> dict[str, float]:
    """Returns by how many nats alternatives fit worse than the likeliest, by name."""
    reference = closest(list(trials.values()))
    least = trials[best].losses(reference.fit.scale).sum()
    return {
        name: reference.share * float(trial.losses(reference.fit.scale).sum() - least)
        for name, trial in trials.items()
        if name != best
    }


def _contains(trial: Hypothesis, name: str, law: Effect) -> bool:
    """Returns whether an effect of a model, by its name, contains a law."""
    effect = next(effect for effect in trial.effects if effect.name == name)
    return effect.port == law.port and law.id in effect.contains


def _strains(
    trials: Mapping[str, Hypothesis], without: Hypothesis, is_approximate: bool
) -> list[float]:
    """Returns the penalties of candidates, in log density.

    Laws that fit only with a shape parameter at its bound are penalised. In approximate models,
    laws that contain simpler ones are penalised, too, and laws that overlap with another effect of
    the model explain nothing of their own.

    Args:
        trials: The model with each candidate, by the candidate's name.
        without: The model without the candidates.
        is_approximate: Whether something remains that no law of the catalogue explains.
    """
    best = closest(list(trials.values()))
    before = float(without.losses(best.fit.scale).sum())
    result = []
    for name, trial in trials.items():
        effect = next(effect for effect in trial.effects if effect.name == name)
        explains = before - float(trial.losses(best.fit.scale).sum())
        share = STRAIN if trial.at_edge(effect) else 0.0
        if is_approximate and (effect.contains or share):
            share = VERDICT.minor_share
        if is_approximate and any(overlap(effect, e) for e in trial.effects if e is not effect):
            share = 1.0
        result.append(share * best.share * max(0.0, explains))
    return result
