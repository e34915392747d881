"""The search: add the effect that explains most, screen again, remove effects no longer needed."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, Self

from torch import Tensor

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.groups import Group, num_counted
from npdr_ppl.discovery.screening.projection import loss_without
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.discovery.search.alternatives import Added, log_prior
from npdr_ppl.discovery.search.comparison import compare_effects
from npdr_ppl.discovery.search.convergence import converge_along_best
from npdr_ppl.discovery.search.deadline import Deadline
from npdr_ppl.discovery.search.evidence import log_evidence, weigh
from npdr_ppl.discovery.search.likelier_group import likelier_group
from npdr_ppl.discovery.search.look import look
from npdr_ppl.discovery.search.original_model import OriginalModel
from npdr_ppl.discovery.search.parsimony import plausible_laws, simplest_laws
from npdr_ppl.discovery.search.repeatability import repeated_effects
from npdr_ppl.discovery.search.rounds import (
    Round,
    Search,
    is_negligible,
    is_single_addition,
    is_something_left,
)
from npdr_ppl.discovery.search.settings import EVIDENCE, SEARCH, TRIALS
from npdr_ppl.discovery.search.shortlist import fit_shortlist
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.language.model import Model
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.progress import Reporter
from npdr_ppl.rollouts import Rollouts

__all__ = ["Searcher"]


class Searcher(OriginalModel):
    """Searches a recording for missing effects.

    Args:
        model: The original model.
        rollouts: The recording.
        options: Settings of the search.
        report: Called with a sentence at each step.
        data_options: How the recording is cut into segments; discovery's defaults if ``None``.
        seed: Seed of all random numbers.
        progress: Where to show how many candidates are done.
        deadline: When to end with the best answer so far.

    Attributes:
        options: Settings of the search.
    """

    def __init__(
        self,
        model: Model,
        rollouts: Rollouts,
        options: DiscoveryOptions,
        report: Callable[[str], None] = lambda _: None,
        *,
        data_options: DataOptions | None = None,
        seed: int = 0,
        progress: Reporter | None = None,
        deadline: Deadline | None = None,
    ) -> None:
        data_options = data_options or segment_options(rollouts)
        super().__init__(model, rollouts, data_options, seed=seed, report=report)
        self._deadline = deadline or Deadline(options.time_limit)
        self.options = options
        self._last: Round | None = None
        self._progress = progress or Reporter()

    def along(self, index: Tensor) -> Self:
        """Returns a searcher of some of the segments, with the current steps and priors.

        Args:
            index: Indices of the segments.
        """
        part = super().along(index)
        part._last = None
        return part

    def run(self, first: Round, *, max_effects: int) -> Search:
        """Adds effects until no alarm fires, no effect helps, or the greatest number is reached.

        Args:
            first: The results for the original model.
            max_effects: Greatest number of effects.

        Returns:
            The result; its first round has finer steps if they were needed.
        """
        current, now, rounds = first.hypothesis, first, [first]
        # A round is tested only if the alarm of the one before fired. So only the first right
        # model can give a false alarm, and the number of rounds is not corrected for (compare
        # Marcus, Peritz & Gabriel 1976). ``benchmarks/discovery.py`` counts effects too many.
        while num_counted(current.effects) < max_effects and is_something_left(first, now):
            # At least the likeliest candidates are fitted, so that there is an answer.
            if len(rounds) > 1 and self._deadline.stops():
                break
            extended, changed = self._with_another(rounds, max_effects)
            if changed:
                # The missing effect had hidden that the steps are too coarse, or that the model's
                # own priors suffice.
                rounds = self._begun_again(rounds, looks=changed == "much")
                first, now = rounds[0], rounds[-1]
                current = now.hypothesis
                continue
            if extended is current:
                break
            current = extended
            if any(set(current.names) == set(r.hypothesis.names) for r in rounds):
                break
            now = self.look(current)
            rounds.append(now)
        return self._revised(current, rounds, max_effects)

    def _with_another(
        self, rounds: list[Round], max_effects: int
    ) -> tuple[Hypothesis, Literal["", "much", "little"]]:
        """Adds what explains most to the last round's model, and removes what it replaces.

        Args:
            rounds: The results so far. What was tried is added to the last one.
            max_effects: Greatest number of effects.

        Returns:
            The model, that of the last round if nothing explains enough; and what was changed with
            it, see :meth:`_settle`.
        """
        first, current = rounds[0].hypothesis, rounds[-1].hypothesis
        best, weights, tried = self._extended(current, rounds[-1])
        rounds[-1] = replace(rounds[-1], weights=weights, trials=tried)
        single = current if best is None else tried[best]
        if is_negligible(first, current, single):
            single = current
        if single is not current:
            single = self.trials.with_own_starts(single)
            changed = self._settle(single, rounds[-1])
            if changed:
                return single, changed
        likelier = self._with_law_at_several(rounds, single, max_effects)
        extended = self._with_likelier_pair(rounds, likelier, max_effects)
        is_new = extended is not single
        if extended is current or (is_new and is_negligible(first, current, extended)):
            return current, ""
        result = self._pruned(extended, None if is_new else best)
        if result is not single:
            result = self.trials.with_own_starts(result)
        return result, self._settle(result, rounds[-1]) if is_new else ""

    def _settle(self, current: Hypothesis, now: Round) -> Literal["", "much", "little"]:
        """Takes finer steps, other commands before the recording, or own priors if needed.

        Errors of the steps differ between laws. A delayed command changes within a step, a late
        measurement does not: in coarse steps, the wrong one of the two can fit better. With wide
        priors it can fit better, too. So the likeliest alternatives are asked as well.

        Args:
            current: The model with the effects that were added.
            now: The round that added the last one, with what it tried.

        Returns:
            ``"much"`` if finer steps or other commands before the recording change the evidence so
            much that other candidates could now explain most, ``"little"`` after any other change,
            empty if nothing was changed.
        """
        if self._deadline.stops():
            return ""
        likeliest = sorted(now.trials, key=lambda name: now.weights[name], reverse=True)
        # Others were not fitted to convergence, and would gain by that alone.
        others = {
            name: now.trials[name]
            for name in likeliest[: TRIALS.most_converged]
            if set(now.trials[name].names) != set(current.names)
        }
        for model in (current, *others.values()):
            finer = self.with_finer_steps(model)
            if finer is not model:
                is_much = log_evidence(model, finer) > TRIALS.certain_evidence
                return "much" if is_much else "little"
            if self.with_likelier_commands_before(model, compared=current) is not model:
                return "much"
        possible = (
            self.trials.with_own_starts(other)
            for name, other in others.items()
            if now.weights[name] >= EVIDENCE.least_probability
        )
        return "little" if self.take_own_priors(current, possible) else ""

    def _begun_again(self, rounds: list[Round], *, looks: bool) -> list[Round]:
        """Returns rounds in the present steps and priors, the last of which is to be done again.

        Candidates whose fit was hopeless before are not fitted again.

        Args:
            rounds: The rounds in coarser steps, or with wider priors.
            looks: Whether to begin with the first round and to screen the candidates again,
                because others could now explain most. Otherwise, the rounds keep their effects
                and candidates, and only their models are fitted again.
        """
        first = rounds[0]
        fitted = self.fit_base(near=first.hypothesis.parameters)
        if looks:
            return [replace(self.look(fitted), hopeless=first.far_behind)]
        again = [first.refitted(fitted)]
        for before in rounds[1:]:
            found = self.trials.refitted(before.hypothesis)
            if found is None:
                break
            again.append(before.refitted(self.trials.with_own_starts(found)))
        return again

    def _revised(self, current: Hypothesis, rounds: list[Round], max_effects: int) -> Search:
        """Returns the effects that are found again, in their simplest form, and alternatives.

        Args:
            current: The model with all effects that were found.
            rounds: The results before each addition, to which those of revised models are added.
            max_effects: Greatest number of effects.
        """
        base = rounds[0].hypothesis
        added: list[Added] = []
        trials: dict[tuple[str, str], Hypothesis] = {}
        is_approximate, minor = False, frozenset[str]()
        if current.effects and self._deadline.stops():
            current, added, trials = self._compared(current, rounds)
            return Search(rounds, current, added, trials, has_stopped=True)
        for _ in range(SEARCH.most_revisions):
            current = repeated_effects(current, self.trials, self._report)
            # As long as something remains that no law explains, the laws are approximations.
            is_approximate = is_something_left(rounds[0], self._looked(current, rounds))
            candidates = candidates_at(base, self.options)
            self._report("seeing whether simpler laws, or fewer, explain as much")
            if is_approximate:
                current, minor = simplest_laws(
                    base, current, candidates, self.trials, self._report
                )
            else:
                minor = frozenset()
                current = plausible_laws(
                    current, candidates, self.trials, self._report, most=max_effects
                )
            current, added, trials = self._compared(current, rounds, is_approximate=is_approximate)
            if current.effects and self._deadline.stops():
                break
            kept = repeated_effects(current, self.trials, self._report)
            if kept is current:
                break
            current = kept
            added = [each for each in added if each.effect.name in current.names]
        is_approximate = is_something_left(rounds[0], self._looked(current, rounds))
        stopped = self._deadline.has_stopped
        return Search(rounds, current, added, trials, is_approximate, stopped, minor)

    def _compared(
        self, current: Hypothesis, rounds: list[Round], *, is_approximate: bool = False
    ) -> tuple[Hypothesis, list[Added], dict[tuple[str, str], Hypothesis]]:
        """Compares each effect with its alternatives; see :func:`compare_effects`."""
        return compare_effects(
            current,
            rounds,
            self.trials,
            self.options,
            is_approximate=is_approximate,
            report=self._report,
            progress=self._progress.stage("compare with alternatives"),
            stops=self._deadline.stops,
        )

    def _looked(self, current: Hypothesis, rounds: list[Round]) -> Round:
        """Returns the last round, after one is added if it has other effects than a hypothesis.

        A round whose model was fitted again is looked at again.
        """
        last = rounds[-1]
        if set(current.names) != set(last.hypothesis.names):
            rounds.append(self.look(current))
        elif last.is_stale:
            seen = self.look(last.hypothesis)
            rounds[-1] = replace(
                seen, hopeless=last.hopeless, weights=last.weights, trials=last.trials
            )
        return rounds[-1]

    def look(self, hypothesis: Hypothesis, *, number: int | None = None) -> Round:
        """Screens all candidates at a fitted hypothesis; the last result is cached.

        Args:
            hypothesis: The fitted hypothesis.
            number: Number of parallel processes; by default that of the enclosing ``workers``
                block. The result does not depend on it.
        """
        if self._last is None or self._last.hypothesis is not hypothesis:
            self._last = look(
                hypothesis,
                self.options,
                seed=self.seed,
                number=number,
                report=self._report,
                progress=self._progress,
            )
        return self._last

    def _extended(
        self, current: Hypothesis, now: Round
    ) -> tuple[str | None, dict[str, float], dict[str, Hypothesis]]:
        """Returns the candidate that explains most, with all weights and trials.

        The candidate must have a p-value below the alarm's false-alarm rate, or there must be
        strong evidence against the model without it. Otherwise ``None`` is returned in its place.
        """
        ranking = now.ranking
        label = f"effect {len(current.effects) + 1}"
        # Candidates that are far behind the best one are skipped.
        step = self._progress.stage(label, may_end_early=True)
        hopeful = [c for c in ranking[: TRIALS.shortlist] if c.name not in now.hopeless]
        trials = fit_shortlist(
            self.trials, current, hopeful, self._report, step, self._deadline.stops
        )
        if not trials:
            return None, {}, {}
        progress = self._progress.stage(label)
        trials = converge_along_best(
            self.trials, trials, current, progress=progress, stops=self._deadline.stops
        )
        if not trials:
            return None, {}, {}
        each = math.log(SEARCH.prior_of_any / max(1, len(ranking)))
        hypotheses = [current, *trials.values()]
        prior = [
            math.log(1 - SEARCH.prior_of_any) + log_prior(current),
            *(each + log_prior(t) for t in trials.values()),
        ]
        weights = dict(zip(("", *trials), weigh(hypotheses, prior), strict=True))
        best = max(trials, key=lambda name: weights[name])
        trials = self.trials.apart_from_waves_in_step(trials)
        if best not in trials:
            self._report(
                f"{best} has the period of the motion or of the commands, so it is no disturbance"
            )
            if not trials:
                return None, weights, trials
            wave, best = best, max(trials, key=lambda name: weights[name])
            if weights[best] < EVIDENCE.least_probability * weights[wave]:
                return None, weights, trials
        is_chance = now.alarm.p_values.get(best, 1.0) > self.options.false_alarm_rate
        if is_chance and weights[""] > 1.0 - self.options.confidence:
            return None, weights, trials
        self._report(f"adding {best}")
        return best, weights, trials

    def _with_law_at_several(
        self, rounds: list[Round], current: Hypothesis, max_effects: int
    ) -> Hypothesis:
        """Returns the model with one law at several joints, if that is likelier.

        With its many strengths such a law explains more than any single effect, also where two
        effects of different kinds are missing. So it is compared with the two effects that were
        added last. It is compared with the model as it is if nothing was added in this round,
        because each joint alone may explain too little, or if nothing more may be added.

        Args:
            rounds: The results before each addition.
            current: The model after the last round's addition, if there was one.
            max_effects: Greatest number of effects.
        """
        asked = [rounds[-2]] if is_single_addition(rounds) else []
        is_full = num_counted(current.effects) >= max_effects
        if current is rounds[-1].hypothesis or is_full:
            asked.append(rounds[-1])
        for before in asked:
            if before.laws and not self._deadline.stops():
                stage = "laws at several joints"
                current = self._likelier(before, before.laws, current, stage, num_new=1)
        return current

    def _with_likelier_pair(
        self, rounds: list[Round], current: Hypothesis, max_effects: int
    ) -> Hypothesis:
        """Returns the model with a pair in place of the effects added last, if that is likelier.

        The effect that was added before the last round may stand for two others. So pairs that do
        not contain it are tried.

        Args:
            rounds: The results before each addition.
            current: The model after the last round's addition, if there was one.
            max_effects: Greatest number of effects.
        """
        if not is_single_addition(rounds):
            return current
        before, after = rounds[-2], rounds[-1].hypothesis
        new = set(after.names) - set(before.hypothesis.names)
        pairs = [pair for pair in before.pairs if not pair.names & new]
        if num_counted(before.hypothesis.effects) + 2 > max_effects:
            return current
        if not pairs or self._deadline.stops():
            return current
        return self._likelier(before, pairs, current, "pairs of effects", num_new=2)

    def _likelier(
        self,
        before: Round,
        groups: Sequence[Group],
        current: Hypothesis,
        stage: str,
        *,
        num_new: int,
    ) -> Hypothesis:
        """Returns the model of a round with the likeliest group, or the current one.

        Args:
            before: The round to whose model a group is added.
            groups: The groups.
            current: The model to compare with.
            stage: What the progress says.
            num_new: As how many effects a group counts.
        """
        found = likelier_group(
            before.hypothesis,
            groups,
            current,
            self.trials,
            num_new=num_new,
            num_candidates=len(before.ranking),
            confidence=self.options.confidence,
            report=self._report,
            progress=self._progress.stage(stage, may_end_early=True),
        )
        return found or current

    def _pruned(self, current: Hypothesis, tested: str | None) -> Hypothesis:
        """Removes effects that are no longer needed after the last addition.

        Args:
            current: The model after the addition.
            tested: Name of the effect that was compared with the model without it.
        """
        for effect in current.effects:
            if effect.name == tested or len(current.effects) == 1:
                continue
            if loss_without(current, effect) > TRIALS.certain_evidence:
                continue
            without = self.trials.without(current, effect)
            if without is None:
                continue
            if _speaks_for(without, current) > self.options.confidence:
                self._report(f"removing {effect.name}")
                current = without
        return current


def _speaks_for(one: Hypothesis, other: Hypothesis) -> float:
    """Returns the probability of the first of two hypotheses."""
    return weigh([one, other], [0.0, 0.0])[0]
