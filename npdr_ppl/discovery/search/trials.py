"""Trials: fits of the original model with different sets of effects to the recording."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, extended, fit_segment_model
from npdr_ppl.discovery.screening.pairs import Pair
from npdr_ppl.discovery.screening.repetition import keeps_in_step
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.evidence import closest, evidence
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.data_options import one_of_each_part
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.preparation.segment_fit import SegmentFit
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.progress import Step

__all__ = ["Trials"]


@dataclass(frozen=True)
class _Fit:
    """The arguments of a fit.

    Attributes:
        segments: The model, effects included, and the recording.
        effects: The effects that were added to the original model.
        start: Initial guess of the parameters, by site.
        offsets: Initial guess of the offsets of the initial states, ``(S, m)``.
        is_trial: Whether a short fit with rough steps is enough.
        held: Reference coordinates of sites that are not fitted.
    """

    segments: SegmentModel
    effects: tuple[Effect, ...]
    start: Mapping[str, Tensor]
    offsets: Tensor
    is_trial: bool = False
    held: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Trials:
    """Fits a model with effects.

    Attributes:
        base: The original model along the recording, whose segments all fits share.
    """

    base: SegmentModel

    def extended(
        self,
        current: Hypothesis,
        ranking: Sequence[Screened],
        report: Callable[[str], None] = lambda _: None,
        progress: Step = lambda fraction, status: None,
    ) -> dict[str, Hypothesis]:
        """Fits the hypothesis with each candidate of the shortlist.

        Each candidate is fitted from its linear estimate, and also from its typical size if its
        change is not linear.

        The best candidates come first. Those whose linear gain is too small to match the best fit
        so far are skipped. Candidates that cannot be simulated are left out.

        Where the best candidate explains very much, a part of the segments shows which candidates
        explain most. The fits are then made along this part; :meth:`converged` fits the best of
        them along all segments.

        Args:
            current: The hypothesis.
            ranking: The candidates, the best first.
            report: Called with a sentence about each candidate.
            progress: Called with the fraction of the shortlist that is fitted.
        """
        if ranking:
            num = _enough_segments(current, ranking[0].gain)
            if num < current.segments.inputs.num_segments:
                index = _part(current.segments, num)
                few, along = Trials(self.base.along(index)), current.along(index)
                return few._extended(along, ranking, report, progress)
        return self._extended(current, ranking, report, progress)

    def _extended(
        self,
        current: Hypothesis,
        ranking: Sequence[Screened],
        report: Callable[[str], None],
        progress: Step,
    ) -> dict[str, Hypothesis]:
        """Fits the hypothesis with each candidate along its own segments."""
        trials: dict[str, Hypothesis] = {}
        waiting = list(ranking[: TRIALS.shortlist])
        done, planned = 0, len(waiting)

        def fitted(number: int) -> None:
            progress(number / planned, f"{number} of {planned} candidates fitted")

        while waiting:
            fitted(done)
            tried, waiting = (
                waiting[: TRIALS.candidates_per_decision],
                waiting[TRIALS.candidates_per_decision :],
            )
            asked = [
                (c, self._trial(current, (c.variant.effect,), guess, current.segments.starts))
                for c in tried
                for guess in _initial_guesses(c)
            ]
            fits = self._fits([fit for _, fit in asked], current.simulator)
            found: dict[str, list[Hypothesis]] = {}
            for (candidate, _), trial in zip(asked, fits, strict=True):
                if trial is not None:
                    found.setdefault(candidate.name, []).append(trial)
            for candidate in tried:
                if candidate.name in found:
                    trials[candidate.name] = _best(found[candidate.name])
                    report(f"tried {candidate.name}: {_shown(trials[candidate.name])}")
                done += 1
                fitted(done)
            if trials:
                far = _far_behind(current, closest(list(trials.values())))
                waiting = [
                    c for c in waiting if c.gain * TRIALS.largest_growth > far * ranking[0].gain
                ]
        return trials

    def with_pairs(
        self,
        current: Hypothesis,
        pairs: Sequence[Pair],
        starts: InitialStates | None,
        report: Callable[[str], None] = lambda _: None,
        progress: Step = lambda fraction, status: None,
    ) -> dict[str, Hypothesis]:
        """Fits the hypothesis with each of several pairs of candidates, from linear estimates.

        Args:
            current: The hypothesis.
            pairs: The pairs.
            starts: Initial states of the segments.
            report: Called with a sentence about each pair.
            progress: Called with the fraction of the pairs that is fitted.

        Returns:
            The model with each pair, by the names of both; pairs that cannot be simulated are left
            out.
        """
        asked = [self._trial(current, pair.effects, pair.parameters, starts) for pair in pairs]
        trials: dict[str, Hypothesis] = {}
        fits = self._fits(asked, current.simulator)
        for number, (pair, found) in enumerate(zip(pairs, fits, strict=True), 1):
            if found is not None:
                trials[pair.name] = found
                report(f"tried {pair.name}: {_shown(found)}")
            progress(number / len(pairs), f"{number} of {len(pairs)} pairs fitted")
        return trials

    def converged(
        self,
        trials: Mapping[str, Hypothesis],
        current: Hypothesis,
        *,
        done: Mapping[str, Hypothesis] | None = None,
        progress: Step = lambda fraction, status: None,
    ) -> dict[str, Hypothesis]:
        """Fits the likeliest trials until convergence.

        At most ``TRIALS.most_converged``, and none whose loss is far above the least.

        Args:
            trials: The model with each of several effects, all along the same segments.
            current: The model without them, along all segments.
            done: Models with further effects whose fits have converged, along all segments.
            progress: Called with the fraction of these trials that has converged.

        Returns:
            The models along all segments, those that are ``done`` included. Trials that were made
            along a part of the segments are left out unless they were fitted again.
        """
        result = dict(done or {})
        if not trials:
            return result
        part = next(iter(trials.values())).segments
        num_segments = current.segments.inputs.num_segments
        is_part = part.inputs.num_segments < num_segments
        known = result
        if is_part:
            index = _part(current.segments, part.inputs.num_segments)
            known = {name: hypothesis.along(index) for name, hypothesis in result.items()}
        compared = {**known, **trials}
        best = closest(list(compared.values()))
        losses = {
            name: float(trial.losses(best.fit.scale).sum()) for name, trial in compared.items()
        }
        least = min(losses.values())
        # By loss alone, laws with more parameters would crowd out the simple law they contain.
        by_block = evidence(list(compared.values()), [0.0] * len(compared), best)
        likelihood = dict(zip(compared, by_block.sum(-1).tolist(), strict=True))
        likeliest = sorted(compared, key=lambda name: -likelihood[name])
        contenders = [
            name
            for name in likeliest[: TRIALS.most_converged]
            if name in trials
            and losses[name]
            <= least + max(TRIALS.converged_loss, TRIALS.converged_share * abs(least))
        ]
        own = [trials[name] for name in contenders]
        if is_part:
            asked = []
            for trial in own:
                segments = self._along(trial.effects, current.segments.starts)
                assert segments is not None
                asked.append(_refit(segments, trial, trial.effects, {}, current.fit.offsets))
        else:
            asked = [_refit(trial.segments, trial, trial.effects, {}) for trial in own]
            result |= trials
        fits = self._fits(asked, current.simulator)
        num = len(contenders)
        progress(0.0, f"0 of {num} best fits converged")
        for number, (name, longer) in enumerate(zip(contenders, fits, strict=True), 1):
            if longer is not None:
                result[name] = longer
            progress(number / num, f"{number} of {num} best fits converged")
        return result

    def refitted(
        self,
        current: Hypothesis,
        effects: tuple[Effect, ...] | None = None,
        *,
        start: Mapping[str, Tensor] | None = None,
    ) -> Hypothesis | None:
        """Fits the model with effects, from the parameters of a hypothesis.

        Args:
            current: The hypothesis.
            effects: The effects; those of the hypothesis by default.
            start: Initial guess of parameters that the hypothesis does not have, by site.

        Returns:
            ``None`` if the model cannot be simulated with them.
        """
        chosen = current.effects if effects is None else effects
        segments = self._along(chosen, current.segments.starts)
        if segments is None:
            return None
        return self.refitted_along(segments, current, chosen, start=start)

    def refitted_along(
        self,
        segments: SegmentModel,
        current: Hypothesis,
        effects: tuple[Effect, ...],
        *,
        start: Mapping[str, Tensor] | None = None,
    ) -> Hypothesis | None:
        """Fits a model that is bound to the recording; see :meth:`refitted`.

        Args:
            segments: The model, effects included, and the recording.
            current: The hypothesis from whose parameters the fit begins.
            effects: The model's effects.
            start: Initial guess of parameters that the hypothesis does not have, by site.
        """
        asked = _refit(segments, current, effects, start or {})
        (found,) = self._fits([asked], current.simulator)
        return found

    def each_refitted(
        self, current: Hypothesis, sets: Sequence[tuple[Effect, ...]]
    ) -> Iterator[Hypothesis | None]:
        """Fits the model with each of several sets of effects; see :meth:`refitted`.

        Args:
            current: The hypothesis from whose parameters the fits begin.
            sets: The sets of effects.
        """
        asked = []
        for effects in sets:
            segments = self._along(effects, current.segments.starts)
            asked.append(None if segments is None else _refit(segments, current, effects, {}))
        return self._fits(asked, current.simulator)

    def with_own_starts(self, current: Hypothesis) -> Hypothesis:
        """Refits a hypothesis with initial states that are estimated along its own motion.

        With the model's help, the initial states are known better than from the measurements
        alone. The size of the fitted offsets shows how well.

        Args:
            current: The hypothesis.
        """
        starts = current.estimated_starts()
        if starts is None:
            return current
        segments = current.segments.starting_from(starts)
        unmoved = torch.zeros_like(current.fit.offsets)
        (found,) = self._fits(
            [_Fit(segments, current.effects, current.parameters, unmoved)], current.simulator
        )
        # If initial states are estimated badly, simulations close to them may fail.
        return current if found is None or not found.can_be_linearised else found

    def holding(
        self,
        current: Hypothesis,
        held: Sequence[Mapping[str, float]],
        progress: Step = lambda fraction, status: None,
    ) -> list[Hypothesis | None]:
        """Refits a hypothesis with some of its parameters held fixed.

        Args:
            current: The hypothesis.
            held: For each wanted hypothesis, reference coordinates by site.
            progress: Called with the fraction of these fits that is done.

        Returns:
            ``None`` in place of those that cannot be simulated.
        """
        effects, start, offsets = current.effects, current.parameters, current.fit.offsets
        asked = [_Fit(current.segments, effects, start, offsets, held=places) for places in held]
        found: list[Hypothesis | None] = []
        progress(0.0, f"0 of {len(asked)} fits")
        for number, refitted in enumerate(self._fits(asked, current.simulator), 1):
            found.append(refitted)
            progress(number / len(asked), f"{number} of {len(asked)} fits")
        return found

    def apart_from_waves_in_step(
        self, tried: Mapping[str, Hypothesis], num_new: int = 1
    ) -> dict[str, Hypothesis]:
        """Removes models with a new wave that is synchronous with the motion.

        Args:
            tried: The models, by name.
            num_new: How many of each model's last effects are new.
        """
        return {
            name: trial
            for name, trial in tried.items()
            if not any(
                keeps_in_step(trial, effect, self.base.rollouts)
                for effect in trial.effects[-num_new:]
            )
        }

    def without(self, current: Hypothesis, effect: Effect) -> Hypothesis | None:
        """Refits a hypothesis without one of its effects; see :meth:`refitted`."""
        return self.refitted(current, tuple(e for e in current.effects if e.name != effect.name))

    def _trial(
        self,
        current: Hypothesis,
        added: tuple[Effect, ...],
        guess: Mapping[str, Tensor],
        starts: InitialStates | None,
    ) -> _Fit | None:
        """Returns the short fit of a hypothesis with further effects from an initial guess.

        Args:
            current: The hypothesis.
            added: The further effects.
            guess: Initial guess of their parameters.
            starts: Initial states of the segments.
        """
        effects = (*current.effects, *added)
        segments = self._along(effects, starts)
        if segments is None:
            return None
        is_same = starts is current.segments.starts
        offsets = current.fit.offsets if is_same else segments.no_offsets
        begin = {**current.parameters, **guess}
        return _Fit(segments, effects, begin, offsets, is_trial=True)

    def _along(
        self, effects: tuple[Effect, ...], starts: InitialStates | None
    ) -> SegmentModel | None:
        """Returns the model with effects along the recording, ``None`` if it cannot have them."""
        try:
            return extended(self.base, effects, starts)
        except NpdrError:
            return None

    def _fits(
        self, asked: Sequence[_Fit | None], simulator: Simulator
    ) -> Iterator[Hypothesis | None]:
        """Yields the hypothesis of each fit, ``None`` where the model cannot be simulated."""
        possible = [fit for fit in asked if fit is not None]
        found = side_by_side(_fitted, possible, num_processes(simulator))
        for fit in asked:
            result = None if fit is None else next(found)
            if fit is None or result is None:
                yield None
                continue
            hypothesis = Hypothesis(fit.segments.model, fit.effects, fit.segments, result[0])
            hypothesis.__dict__["difference"] = result[1]  # else it would be simulated again
            yield hypothesis


def _enough_segments(current: Hypothesis, gain: float) -> int:
    """Returns how many segments show which candidates explain most.

    Args:
        current: The hypothesis.
        gain: Linear gain of the best candidate along all segments.
    """
    num = current.segments.inputs.num_segments
    evidence_of_all = 0.5 * current.share * gain
    if evidence_of_all <= TRIALS.enough_evidence:
        return num
    return min(
        num, max(TRIALS.fewest_segments, math.ceil(num * TRIALS.enough_evidence / evidence_of_all))
    )


def _part(segments: SegmentModel, num: int) -> Tensor:
    """Returns the indices of a number of segments from the whole recording."""
    return one_of_each_part(num, segments.inputs.num_segments, seed=0)


def _initial_guesses(candidate: Screened) -> list[dict[str, Tensor]]:
    """Returns the initial guesses of a candidate's fits.

    They are the linear estimate, and the typical size if the change is not linear. The linear
    estimate can then be far from the best fit, with a local minimum between them: a lag beside a
    delay that already explains their sum. Many sizes of a resonance are screened, and fits of
    effects with many minima restart by themselves.
    """
    variant, effect = candidate.variant, candidate.variant.effect
    guesses = [variant.parameters(candidate.sizes)]
    if not (variant.is_linear or effect.is_resonant or effect.has_local_minima):
        guesses.append(variant.parameters(torch.ones_like(candidate.sizes)))
    return guesses


def _best(trials: Sequence[Hypothesis]) -> Hypothesis:
    """Returns the hypothesis with the least loss."""
    scale = closest(trials).fit.scale
    return min(trials, key=lambda trial: float(trial.losses(scale).sum()))


def _refit(
    segments: SegmentModel,
    current: Hypothesis,
    effects: tuple[Effect, ...],
    start: Mapping[str, Tensor],
    offsets: Tensor | None = None,
) -> _Fit:
    """Returns the fit of a model from a hypothesis's parameters and further ones.

    The offsets are the hypothesis's own by default.
    """
    kept = {name for effect in effects for name in effect.parameter_names}
    gone = {name for effect in current.effects for name in effect.parameter_names} - kept
    begin = {name: value for name, value in current.parameters.items() if name not in gone}
    begun = current.fit.offsets if offsets is None else offsets
    return _Fit(segments, effects, {**begin, **start}, begun)


def _fitted(asked: _Fit) -> tuple[SegmentFit, Tensor] | None:
    """Fits a model; returns ``None`` if it cannot be simulated.

    A parallel process sends only the fit and the difference from the recording, because the
    asking process has the segments.
    """
    try:
        found = fit_segment_model(
            asked.segments,
            effects=asked.effects,
            start=asked.start,
            offsets=asked.offsets,
            held=asked.held,
            max_steps=TRIALS.first_steps if asked.is_trial else TRIALS.most_steps,
            is_rough=asked.is_trial,
        )
    except NpdrError:
        return None
    return found.fit, found.difference


def _far_behind(current: Hypothesis, best: Hypothesis) -> float:
    """Returns the share of the best trial's gain that another must reach to be an alternative."""
    scale = best.fit.scale
    explained = best.share * float((current.losses(scale) - best.losses(scale)).sum())
    return 1.0 - TRIALS.certain_evidence / max(explained, TRIALS.certain_evidence)


def _shown(hypothesis: Hypothesis) -> str:
    return ", ".join(
        f"{name} {scale:.3g}"
        for name, scale in zip(
            hypothesis.segments.channel_names, hypothesis.fit.scale.tolist(), strict=True
        )
    )
