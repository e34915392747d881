"""Alternatives: what else could stand in the place of an effect, all others being there."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.candidate_effects import candidates_at, variants_of
from npdr_ppl.discovery.screening.generic_laws import FREQUENCIES
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.search.evidence import INDISTINCT, closest, weigh
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.language.effects import Effect

__all__ = [
    "Added",
    "Alternatives",
    "find_alternatives",
    "log_prior",
    "tried_before",
    "weigh_alternatives",
]

STRAIN = 0.02
"""Share of what it explains by which a law that fits only in a limit of its shape must be ahead of
one that needs none: there it is likely the other law, and what differs is how an engine solves it,
as dry friction whose bristles hardly bend."""


@dataclass(frozen=True)
class Added:
    """An effect that the search ended with.

    Attributes:
        effect: The effect.
        place: Name of the effect in whose place it stands, by which its trials are found.
        share: Share of all that was explained which is lost without it.
        alternatives: Probability of the effects that could stand in its place, itself included,
            given all others, by name.
        fitting: Names of those that fit as well. The simplest is the likeliest, but a law that
            contains it, as bristles contain dry friction, is as good where its further
            parameters do not show.
    """

    effect: Effect
    place: str
    share: float
    alternatives: dict[str, float]
    fitting: tuple[str, ...] = ()

    @property
    def probability(self) -> float:
        """Probability of the effect, given all others."""
        return self.alternatives[self.effect.name]


@dataclass(frozen=True)
class Alternatives:
    """What could stand in an effect's place.

    Attributes:
        without: The model without the effect.
        with_it: The model with the effect, as it was when the others were tried: with the same
            states to start from.
        others: The model with each other that could stand there, by name.
    """

    without: Hypothesis
    with_it: Hypothesis
    others: dict[str, Hypothesis]


def find_alternatives(
    current: Hypothesis,
    effect: Effect,
    trials: Trials,
    options: DiscoveryOptions,
) -> Alternatives | None:
    """Fits the model with others in an effect's place.

    Args:
        current: The model with the effect.
        effect: The effect.
        trials: Fits the model.
        options: How to search.

    Returns:
        ``None`` if the model cannot be simulated without the effect.
    """
    without = trials.without(current, effect)
    if without is None:
        return None
    candidates = tuple(e for e in candidates_at(without, options) if e.name != effect.name)
    averaged = without.averaged()
    projection = Projection(averaged)
    ranking = screen(projection, variants_of(candidates, projection, responses(averaged)))
    tried = {effect.name: current} | trials.extended(without, ranking)
    tried = trials.converged(tried, done=effect.name)
    others = {name: h for name, h in tried.items() if name != effect.name}
    return Alternatives(without, current, trials.apart_from_waves_in_step(others))


def tried_before(
    current: Hypothesis,
    effect: Effect,
    seen: Sequence[tuple[Hypothesis, Mapping[str, Hypothesis]]],
) -> Alternatives | None:
    """Returns the alternatives of an effect if they were tried already, when it was added last.

    Args:
        current: The model with the effect.
        effect: The effect.
        seen: Hypotheses that were looked at, and the same with each candidate tried, by name.
    """
    rest = set(current.names) - {effect.name}
    for hypothesis, tried in seen:
        if set(hypothesis.names) == rest and effect.name in tried:
            others = {name: trial for name, trial in tried.items() if name != effect.name}
            return Alternatives(hypothesis, tried[effect.name], others)
    return None


def weigh_alternatives(
    base: Hypothesis, current: Hypothesis, effect: Effect, alternatives: Alternatives | None
) -> tuple[Hypothesis, Added]:
    """Asks which of the alternatives it is.

    Args:
        base: The model in question.
        current: The model with the effect.
        effect: The effect.
        alternatives: What could stand in its place.

    Returns:
        The model with the likeliest, and what that is.
    """
    if alternatives is None:
        return current, Added(effect, effect.name, 1.0, {effect.name: 1.0})
    without, trials = (
        alternatives.without,
        {effect.name: alternatives.with_it} | alternatives.others,
    )
    prior = [
        log_prior(trial) - strain
        for trial, strain in zip(trials.values(), _strains(trials, without), strict=True)
    ]
    weights = weigh(list(trials.values()), prior, seed=0)
    probabilities = dict(zip(trials, weights, strict=True))
    best = max(probabilities, key=lambda name: probabilities[name])
    swapped = trials[best]
    chosen = next(e for e in swapped.effects if e.name == best)
    scale = closest([base, swapped]).fit.scale
    whole, lost = (float((h.losses(scale) - swapped.losses(scale)).sum()) for h in (base, without))
    share = max(0.0, lost) / max(whole, 1e-12)
    fitting = _fitting(trials, best)
    swapped = current if best == effect.name else swapped
    return swapped, Added(chosen, effect.name, share, probabilities, fitting)


def log_prior(hypothesis: Hypothesis) -> float:
    """Returns what the search over frequencies costs, as so many hypotheses share one's prior."""
    waves = sum(bool(effect.wave) for effect in hypothesis.effects)
    return -waves * math.log(FREQUENCIES)


def _fitting(trials: Mapping[str, Hypothesis], best: str) -> tuple[str, ...]:
    """Returns the names of those that fit hardly worse than the likeliest, if at all."""
    reference = closest(list(trials.values()))
    least = trials[best].losses(reference.fit.scale).sum()
    return tuple(
        name
        for name, trial in trials.items()
        if name != best
        and reference.share * float(trial.losses(reference.fit.scale).sum() - least) < INDISTINCT
    )


def _strains(trials: Mapping[str, Hypothesis], without: Hypothesis) -> list[float]:
    """Returns by how much evidence each candidate must be ahead of laws that fit without strain.

    Args:
        trials: The model with each candidate, by the candidate's name.
        without: The model without any.
    """
    best = closest(list(trials.values()))
    before = float(without.losses(best.fit.scale).sum())
    result = []
    for name, trial in trials.items():
        effect = next(effect for effect in trial.effects if effect.name == name)
        explains = before - float(trial.losses(best.fit.scale).sum())
        share = STRAIN if trial.at_edge(effect) else 0.0
        result.append(share * best.share * max(0.0, explains))
    return result
