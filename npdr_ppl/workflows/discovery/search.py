"""The search: add the effect that explains most, look again, take back what became needless."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from torch import Tensor

from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.handlers import with_finer_steps
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models.effects import candidate_effects
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.discovery.alarm import Alarm, sound_alarm
from npdr_ppl.workflows.discovery.equivalents import irreducible
from npdr_ppl.workflows.discovery.evidence import closest, weigh
from npdr_ppl.workflows.discovery.generic_laws import FREQUENCIES, strongest_frequency
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis, Model, fit_hypothesis, with_effects
from npdr_ppl.workflows.discovery.latent_force import Responses, responses
from npdr_ppl.workflows.discovery.options import DiscoveryOptions
from npdr_ppl.workflows.discovery.projection import Projection, loss_without
from npdr_ppl.workflows.discovery.screening import Screened, screen
from npdr_ppl.workflows.discovery.sensitivities import Variant, sensitivities
from npdr_ppl.workflows.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.workflows.segment_fit import SegmentModel

__all__ = ["Added", "Round", "Search", "Searcher", "explained"]

SHORTLIST = 6
"""Candidates fitted in full in each round."""

MAX_STEPS = 12
"""Steps of a fit."""

TRIAL_STEPS = 6
"""Steps of a fit that shows whether a candidate is worth a longer one."""

CONTENDERS = 3
"""Candidates that are fitted to the end."""

CONTENDS = 0.3
"""A candidate contends whose loss is at most this much above the least, relatively …"""

CONTENDS_ANYWAY = 20.0
"""… or this much, absolutely."""

LEAST_SHARE = 1e-4
"""Share of what was explained below which what is left is not looked into: where a large effect
was missing, integrators and the laws' own details differ by as much."""

STRAIN = 0.02
"""Share of what it explains by which a law that fits only in a limit of its shape must be ahead of
one that needs none: there it is likely the other law, and what differs is how an engine solves it,
as dry friction whose bristles hardly bend."""

PLAINLY = 30.0
"""Evidence, estimated to first order, from which an effect is kept without fitting the model that
lacks it."""

NOTICEABLE = 0.05
"""Error of integration, relative to what a fit leaves of a channel, from which finer steps are
taken unless the recording speaks against them: effects would be found that make up for it."""

PRIOR_OF_ANY = 0.5
"""Prior probability that anything of the catalogue is missing."""


@dataclass(frozen=True)
class Round:
    """What was seen at one state of the model.

    Attributes:
        hypothesis: The model as it was, fitted.
        alarm: Whether something was missing then.
        ranking: The candidates by linear gain.
        responses: What pulses of force at the joints would change.
        weights: Probability of each candidate fitted in full, by name; ``""`` for none.
        trials: The model with each of them, by name.
    """

    hypothesis: Hypothesis
    alarm: Alarm
    ranking: list[Screened]
    responses: Responses
    weights: dict[str, float] = field(default_factory=dict)
    trials: dict[str, Hypothesis] = field(default_factory=dict)


@dataclass(frozen=True)
class Added:
    """An effect that the search ended with.

    Attributes:
        effect: The effect.
        place: Name of the effect in whose place it stands, by which its trials are found.
        share: Share of all that was explained which is lost without it.
        alternatives: Probability of the effects that could stand in its place, itself included,
            given all others, by name.
    """

    effect: Effect
    place: str
    share: float
    alternatives: dict[str, float]

    @property
    def probability(self) -> float:
        """Probability of the effect, given all others."""
        return self.alternatives[self.effect.name]


@dataclass(frozen=True)
class Search:
    """What the search came to.

    Attributes:
        rounds: What was seen before each addition, and at last.
        final: The model at last.
        added: Its effects.
        removed: Names of effects that were added and taken back.
        trials: Hypotheses of the last look at each effect, by the name of what stood in for what.
    """

    rounds: list[Round]
    final: Hypothesis
    added: list[Added]
    removed: list[str]
    trials: dict[tuple[str, str], Hypothesis]


@dataclass(frozen=True)
class _Fit:
    """A fit to be made.

    Attributes:
        effects: The effects that the model is to have.
        start: Parameters to begin with, by site.
        offsets: Offsets of the initial states to begin with, ``(S, m)``.
        is_trial: Whether rough steps will do.
    """

    effects: tuple[Effect, ...]
    start: Mapping[str, Tensor]
    offsets: Tensor
    is_trial: bool = False


class Searcher:
    """Searches a recording for missing effects.

    Args:
        model: The model in question.
        rollouts: The recording.
        options: How to search.
        report: Called with a sentence at each step.

    Attributes:
        model: The model in question, in finer steps once its own have turned out too coarse.
        are_steps_coarse: Whether they have.
    """

    def __init__(
        self,
        model: Model,
        rollouts: Rollouts,
        options: DiscoveryOptions,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.model = model
        self.rollouts = rollouts
        self.options = options
        self.binding: BindingOptions = options.binding(rollouts)
        self.are_steps_coarse = False
        self._report = report

    def fit_base(self) -> Hypothesis:
        """Fits the model as it is."""
        self._report("fitting the model as it is")
        return fit_hypothesis(self.model, self.rollouts, self.binding)

    def with_finer_steps(self, current: Hypothesis) -> Hypothesis:
        """Returns the hypothesis in finer steps, where its own err noticeably; else as it is.

        The error of coarse steps would be found as a delay. A recording that was itself made in
        coarse steps is left to them. All later hypotheses are in the steps of what is returned.

        Args:
            current: A fitted hypothesis.
        """
        if current.simulator.with_finer_steps() is None:
            return current
        coarse, self.model = self.model, with_finer_steps(self.model)
        if self._step_error(current) > NOTICEABLE:
            finer = self._fit(current.effects, current.parameters, current)
            if finer is not None:
                if weigh([current, finer], [0.0, 0.0], seed=0)[0] < self.options.confidence:
                    self._report("the model's steps are too coarse for this recording: finer ones")
                    self.are_steps_coarse = True
                    return finer
        self.model = coarse
        return current

    def _step_error(self, current: Hypothesis) -> float:
        """Returns what the model's steps change, relative to what a hypothesis in others leaves.

        The root mean square over the recording, of the channel where it is greatest.
        """
        fit, model = current.fit, with_effects(self.model, current.effects)
        finer = SegmentModel(model, self.rollouts, self.binding)
        here = fit.z[None], fit.offsets[None]
        difference = finer.simulate(*here) - current.segments.simulate(*here)
        error = finer.root_mean_square(difference[0]) / fit.scale
        return float(error.nan_to_num(math.inf).max())

    def run(self, first: Round, *, max_effects: int) -> Search:
        """Adds effects until no alarm fires, nothing helps, or there are enough.

        Args:
            first: What was seen at the model as it is.
            max_effects: How many are enough.

        Returns:
            What came of it; its first round is in finer steps if those turned out to be needed.
        """
        current, now = first.hypothesis, first
        rounds = [first]
        removed: list[str] = []
        while (
            now.alarm.fired
            and len(current.effects) < max_effects
            and now.alarm.gain > LEAST_SHARE * explained(first.hypothesis, current)
        ):
            best, weights, tried = self._extended(current, now)
            rounds[-1] = replace(now, weights=weights, trials=tried)
            if best is None:
                break
            current, needless = self._pruned(tried[best])
            removed += needless
            if self.with_finer_steps(current) is not current:
                # What was missing had hidden how coarse they are: begin anew.
                current = self.fit_base()
                first = now = self.look(current)
                rounds, removed = [first], []
                continue
            if any(set(current.names) == set(r.hypothesis.names) for r in rounds):
                break
            now = self.look(current)
            rounds.append(now)
        added: list[Added] = []
        trials: dict[tuple[str, str], Hypothesis] = {}
        for effect in current.effects:
            current, alternatives, rivals = self._alternatives(current, effect, rounds)
            trials |= rivals
            added.append(alternatives)
        if set(current.names) != set(rounds[-1].hypothesis.names):
            rounds.append(self.look(current))  # something was swapped: what is left is another
        return Search(rounds, current, added, removed, trials)

    def look(self, hypothesis: Hypothesis) -> Round:
        """Screens all candidates at a fitted hypothesis."""
        projection = Projection(hypothesis)
        found = responses(hypothesis)
        variants = self._variants(projection, hypothesis, self._candidates(hypothesis), found)
        ranking = screen(projection, variants)
        sensors = hypothesis.simulator.sensors
        plain = [variant for variant in variants if not variant.is_hinted]
        looks = len(hypothesis.effects)
        alarm = sound_alarm(projection, plain, ranking, found, sensors, self.options, looks)
        best = ", ".join(s.name for s in ranking[:3]) or "none"
        self._report(f"p = {alarm.p_value:.2g} ({alarm.loudest}); the best candidates are {best}")
        return Round(hypothesis, alarm, ranking, found)

    def _variants(
        self,
        projection: Projection,
        hypothesis: Hypothesis,
        candidates: tuple[Effect, ...],
        found: Responses,
    ) -> list[Variant]:
        hints = {
            effect.name: {effect.wave: strongest_frequency(projection, found, effect.port)}
            for effect in candidates
            if effect.wave and effect.port in found.by_port
        }
        # Dealt out in turn, so that each process gets effects of every kind.
        number = num_processes(hypothesis.simulator)
        parts = [candidates[k::number] for k in range(number)]
        function = partial(sensitivities, hypothesis, hints=hints)
        variants: list[Variant] = []
        for part in side_by_side(function, parts, number):
            variants += part
        order = {effect.name: place for place, effect in enumerate(candidates)}
        return sorted(variants, key=lambda variant: order[variant.effect.name])

    def _candidates(self, hypothesis: Hypothesis) -> tuple[Effect, ...]:
        """Returns the effects that may be added."""
        if self.options.effects is not None:
            return tuple(e for e in self.options.effects if e.name not in hypothesis.names)
        return irreducible(candidate_effects(hypothesis.simulator), hypothesis.names)

    def _extended(
        self, current: Hypothesis, now: Round
    ) -> tuple[str | None, dict[str, float], dict[str, Hypothesis]]:
        """Returns the candidate that explains most, unless none does, with weights and trials.

        A candidate explains something if chance does not, as the alarm counts, or if the evidence
        against the model without it is strong.
        """
        ranking = now.ranking
        trials = self._tried(current, ranking, report=self._report)
        if not trials:
            return None, {}, {}
        trials = self._converged(trials)
        each = math.log(PRIOR_OF_ANY / max(1, len(ranking)))
        hypotheses = [current, *trials.values()]
        log_prior = [math.log(1 - PRIOR_OF_ANY), *(each + _log_prior(t) for t in trials.values())]
        weights = dict(zip(("", *trials), weigh(hypotheses, log_prior, seed=0), strict=True))
        best = max(trials, key=lambda name: weights[name])
        is_chance = now.alarm.p_values.get(best, 1.0) > self.options.false_alarm_rate
        if is_chance and weights[""] > 1.0 - self.options.confidence:
            return None, weights, trials
        self._report(f"adding {best}")
        return best, weights, trials

    def _tried(
        self,
        current: Hypothesis,
        ranking: list[Screened],
        report: Callable[[str], None] = lambda _: None,
    ) -> dict[str, Hypothesis]:
        """Returns the model with each of the shortlist, fitted from where its linear gain is."""
        shortlist = ranking[:SHORTLIST]
        asked = [
            _Fit(
                (*current.effects, candidate.variant.effect),
                current.parameters | candidate.variant.parameters(candidate.sizes),
                current.fit.offsets,
                is_trial=True,
            )
            for candidate in shortlist
        ]
        trials = {}
        for candidate, found in zip(shortlist, self._fits(asked, current.simulator), strict=True):
            if found is not None:
                trials[candidate.name] = found
                report(f"tried {candidate.name}: {_shown(found)}")
        return trials

    def _converged(
        self, trials: dict[str, Hypothesis], *, done: str | None = None
    ) -> dict[str, Hypothesis]:
        """Fits the contenders to the end; the others are too far behind for that to matter.

        Args:
            trials: The model with each of several effects.
            done: The one that is at its end already.
        """
        scale = closest(list(trials.values())).fit.scale
        losses = {name: float(trial.losses(scale).sum()) for name, trial in trials.items()}
        least = min(losses.values())
        contenders = [
            name
            for name in sorted(losses, key=lambda name: losses[name])[:CONTENDERS]
            if name != done and losses[name] <= least + max(CONTENDS_ANYWAY, CONTENDS * abs(least))
        ]
        asked = [
            _Fit(trial.effects, trial.parameters, trial.fit.offsets)
            for trial in (trials[name] for name in contenders)
        ]
        result = dict(trials)
        fits = self._fits(asked, next(iter(trials.values())).simulator)
        for name, longer in zip(contenders, fits, strict=True):
            result[name] = longer or trials[name]
        return result

    def _fit(
        self,
        effects: tuple[Effect, ...],
        start: Mapping[str, Tensor],
        current: Hypothesis,
    ) -> Hypothesis | None:
        """Returns the model with effects, fitted; ``None`` if it cannot be simulated."""
        (found,) = self._fits([_Fit(effects, start, current.fit.offsets)], current.simulator)
        return found

    def _fits(self, asked: Sequence[_Fit], simulator: Simulator) -> Iterator[Hypothesis | None]:
        """Yields the model with the effects of each fit, ``None`` where it cannot be simulated."""
        function = partial(_fitted, self.model, self.rollouts, self.binding)
        return side_by_side(function, asked, num_processes(simulator))

    def _without(self, current: Hypothesis, effect: Effect) -> Hypothesis | None:
        rest = tuple(e for e in current.effects if e.name != effect.name)
        start = {k: v for k, v in current.parameters.items() if k not in effect.parameter_names}
        return self._fit(rest, start, current)

    def _pruned(self, current: Hypothesis) -> tuple[Hypothesis, list[str]]:
        """Takes back effects that the last addition made needless."""
        removed: list[str] = []
        for effect in current.effects[:-1]:
            if loss_without(current, effect) > PLAINLY:
                continue
            without = self._without(current, effect)
            if without is None:
                continue
            if weigh([without, current], [0.0, 0.0], seed=0)[0] > self.options.confidence:
                self._report(f"removing {effect.name}")
                current, removed = without, [*removed, effect.name]
        return current, removed

    def _alternatives(
        self, current: Hypothesis, effect: Effect, rounds: list[Round]
    ) -> tuple[Hypothesis, Added, dict[tuple[str, str], Hypothesis]]:
        """Asks what else could stand in an effect's place, all others being there."""
        found = self._rivals(current, effect, rounds)
        if found is None:
            return current, Added(effect, effect.name, 1.0, {effect.name: 1.0}), {}
        without, trials = found
        log_prior = [
            _log_prior(trial) - strain
            for trial, strain in zip(trials.values(), _strains(trials, without), strict=True)
        ]
        weights = weigh(list(trials.values()), log_prior, seed=0)
        alternatives = dict(zip(trials, weights, strict=True))
        best = max(alternatives, key=lambda name: alternatives[name])
        swapped = trials[best]
        chosen = next(e for e in swapped.effects if e.name == best)
        self._report(f"{effect.name}: probability {alternatives[effect.name]:.2f}")
        tried = {(effect.name, name): trial for name, trial in trials.items()}
        base = rounds[0].hypothesis
        scale = closest([base, swapped]).fit.scale
        whole, lost = (
            float((h.losses(scale) - swapped.losses(scale)).sum()) for h in (base, without)
        )
        share = max(0.0, lost) / max(whole, 1e-12)
        return swapped, Added(chosen, effect.name, share, alternatives), tried

    def _rivals(
        self, current: Hypothesis, effect: Effect, rounds: list[Round]
    ) -> tuple[Hypothesis, dict[str, Hypothesis]] | None:
        """Returns the model without an effect, and with each that could stand in its place.

        The effect itself is among them. A round that looked at the same effects has tried them
        already. ``None`` if the model cannot be simulated without.
        """
        rest = set(current.names) - {effect.name}
        for seen in rounds:
            if set(seen.hypothesis.names) == rest and effect.name in seen.trials:
                return seen.hypothesis, seen.trials | {effect.name: current}
        without = self._without(current, effect)
        if without is None:
            return None
        candidates = tuple(e for e in self._candidates(without) if e.name != effect.name)
        projection = Projection(without)
        pulses = responses(without)
        ranking = screen(projection, self._variants(projection, without, candidates, pulses))
        trials = {effect.name: current} | self._tried(without, ranking)
        return without, self._converged(trials, done=effect.name)


def _fitted(
    model: Model, rollouts: Rollouts, binding: BindingOptions, asked: _Fit
) -> Hypothesis | None:
    """Returns a fitted model; ``None`` if it cannot be simulated."""
    try:
        return fit_hypothesis(
            model,
            rollouts,
            binding,
            effects=asked.effects,
            start=asked.start,
            offsets=asked.offsets,
            max_steps=TRIAL_STEPS if asked.is_trial else MAX_STEPS,
            is_rough=asked.is_trial,
        )
    except NpdrError:
        return None


def _shown(hypothesis: Hypothesis) -> str:
    return ", ".join(
        f"{name} {scale:.3g}"
        for name, scale in zip(
            hypothesis.segments.channel_names, hypothesis.fit.scale.tolist(), strict=True
        )
    )


def explained(first: Hypothesis, final: Hypothesis) -> float:
    """Returns by how much the misfit was reduced, in units of the readings' variance."""
    scale = closest([first, final]).fit.scale
    return max(0.0, 2.0 * float((first.losses(scale) - final.losses(scale)).sum()))


def _log_prior(hypothesis: Hypothesis) -> float:
    """Returns what the search over frequencies costs, as so many hypotheses share one's prior."""
    waves = sum(bool(effect.wave) for effect in hypothesis.effects)
    return -waves * math.log(FREQUENCIES)


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
