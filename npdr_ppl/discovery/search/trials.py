"""Trials: fits of the original model with different sets of effects to the recording."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, extended, fit_segment_model
from npdr_ppl.discovery.screening.repetition import keeps_in_step
from npdr_ppl.discovery.search.fits_at_ends import gain, threshold, with_wider_strengths
from npdr_ppl.discovery.search.settings import PRIOR_ENDS, TRIALS
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_fit import SegmentFit
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.progress import Step

__all__ = ["Fit", "Trials", "refit"]


@dataclass(frozen=True)
class Fit:
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
        segments = self.with_effects(chosen, current.segments.starts)
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
        asked = refit(segments, current, effects, start or {})
        (found,) = self.fits([asked], current.simulator)
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
            segments = self.with_effects(effects, current.segments.starts)
            asked.append(None if segments is None else refit(segments, current, effects, {}))
        return self.fits(asked, current.simulator)

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
        (found,) = self.fits(
            [Fit(segments, current.effects, current.parameters, unmoved)], current.simulator
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
        asked = [Fit(current.segments, effects, start, offsets, held=places) for places in held]
        found: list[Hypothesis | None] = []
        progress(0.0, f"0 of {len(asked)} fits")
        for number, refitted in enumerate(self.fits(asked, current.simulator), 1):
            found.append(refitted)
            progress(number / len(asked), f"{number} of {len(asked)} fits")
        return found

    def apart_from_waves_in_step(
        self, tried: Mapping[str, Hypothesis], num_new: int = 1
    ) -> dict[str, Hypothesis]:
        """Removes models with a new wave that is synchronous with the motion or the commands.

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

    def extension(
        self,
        current: Hypothesis,
        added: tuple[Effect, ...],
        guess: Mapping[str, Tensor],
        starts: InitialStates | None,
        offsets: Tensor | None = None,
    ) -> Fit | None:
        """Returns the short fit of a hypothesis with further effects from an initial guess.

        Args:
            current: The hypothesis.
            added: The further effects.
            guess: Initial guess of their parameters.
            starts: Initial states of the segments.
            offsets: Initial guess of their offsets, ``(S, m)``; by default those of the
                hypothesis, or none if it has other initial states.
        """
        effects = (*current.effects, *added)
        segments = self.with_effects(effects, starts)
        if segments is None:
            return None
        if offsets is None:
            is_same = starts is current.segments.starts
            offsets = current.fit.offsets if is_same else segments.no_offsets
        begin = {**current.parameters, **guess}
        return Fit(segments, effects, begin, offsets, is_trial=True)

    def with_effects(
        self, effects: tuple[Effect, ...], starts: InitialStates | None
    ) -> SegmentModel | None:
        """Returns the model with effects along the recording, ``None`` if it cannot have them."""
        try:
            return extended(self.base, effects, starts)
        except NpdrError:
            return None

    def fits(
        self, asked: Sequence[Fit | None], simulator: Simulator
    ) -> Iterator[Hypothesis | None]:
        """Yields the hypothesis of each fit, ``None`` where the model cannot be simulated.

        The priors of effects' strengths are widened where the fit is at their end, if it then fits
        better. Effects that the bound model already has keep their priors.
        """
        possible = [fit for fit in asked if fit is not None]
        found = side_by_side(_fitted, possible, num_processes(simulator))
        for fit in asked:
            result = None if fit is None else next(found)
            if fit is None or result is None:
                yield None
                continue
            hypothesis = result.hypothesis(fit)
            yield hypothesis if fit.held else self._in_wide_priors(hypothesis, fit)

    def _in_wide_priors(self, current: Hypothesis, asked: Fit) -> Hypothesis:
        """Returns a fit with wider priors of strengths at their ends, if these help.

        Args:
            current: The fit with the present priors.
            asked: Its arguments.
        """
        for _ in range(PRIOR_ENDS.most_widenings):
            effects, sites = with_wider_strengths(current)
            segments = self.with_effects(effects, current.segments.starts) if sites else None
            if segments is None:
                break
            again = replace(refit(segments, current, effects, {}), is_trial=asked.is_trial)
            result = _fitted(again)
            if result is None:
                break
            wide = result.hypothesis(again)
            if gain(current, wide) < threshold(sites):
                break
            current = wide
        return current


def refit(
    segments: SegmentModel,
    current: Hypothesis,
    effects: tuple[Effect, ...],
    start: Mapping[str, Tensor],
    offsets: Tensor | None = None,
) -> Fit:
    """Returns the fit of a model from a hypothesis's parameters and further ones.

    The offsets are the hypothesis's own by default.
    """
    kept = {name for effect in effects for name in effect.parameter_names}
    gone = {name for effect in current.effects for name in effect.parameter_names} - kept
    begin = {name: value for name, value in current.parameters.items() if name not in gone}
    begun = current.fit.offsets if offsets is None else offsets
    return Fit(segments, effects, {**begin, **start}, begun)


@dataclass(frozen=True)
class _Fitted:
    """What is known of a fit; the asking process has the segments."""

    fit: SegmentFit
    difference: Tensor
    linearisation: Linearisation | None

    def hypothesis(self, asked: Fit) -> Hypothesis:
        """Returns the fitted model with all that is known of it."""
        found = Hypothesis(asked.segments.model, asked.effects, asked.segments, self.fit)
        found.keep_difference(self.difference)
        if self.linearisation is not None:
            found.keep_linearisation(self.linearisation)
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out the linearisation, which the asking process computes again if it needs it."""
        return {**vars(self), "linearisation": None}


def _fitted(asked: Fit) -> _Fitted | None:
    """Fits a model; returns ``None`` if it cannot be simulated."""
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
    return _Fitted(found.fit, found.difference, found.known_linearisation)
