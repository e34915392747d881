"""Trials: the model in question with one set of effects or another, fitted to the recording."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, Model, fit_hypothesis
from npdr_ppl.discovery.screening.repetition import keeps_in_step
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.rollouts import Rollouts

__all__ = ["PLAINLY", "SHORTLIST", "Trials"]

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

TOGETHER = 2
"""Candidates that are tried before it is asked whether others are worth it."""

GROWTH = 4.0
"""How much more a candidate may explain than its linear gain says, beside that of the best: on
rigs for tuning 3.4 at most where it explains a tenth or more."""

PLAINLY = 30.0
"""Evidence that settles which of two it is."""


@dataclass(frozen=True)
class _Fit:
    """A fit to be made.

    Attributes:
        effects: The effects that the model is to have.
        start: Parameters to begin with, by site.
        offsets: Offsets of the initial states to begin with, ``(S, m)``.
        starts: What the segments start from.
        is_trial: Whether rough steps will do.
        held: Reference coordinates of sites that are not fitted.
    """

    effects: tuple[Effect, ...]
    start: Mapping[str, Tensor]
    offsets: Tensor
    starts: InitialStates | None
    is_trial: bool = False
    held: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Trials:
    """Fits a model with effects.

    Attributes:
        model: The model in question.
        rollouts: The recording.
        binding: Its segments.
    """

    model: Model
    rollouts: Rollouts
    binding: DataOptions

    def extended(
        self,
        current: Hypothesis,
        ranking: Sequence[Screened],
        report: Callable[[str], None] = lambda _: None,
    ) -> dict[str, Hypothesis]:
        """Returns a hypothesis with each of the shortlist, fitted from where its linear gain is.

        In turn, and not those that by their linear gain are too far behind what has been found.
        Candidates that cannot be simulated are left out.

        Args:
            current: The hypothesis.
            ranking: The candidates, the best first.
            report: Called with a sentence about each.
        """
        trials: dict[str, Hypothesis] = {}
        waiting = list(ranking[:SHORTLIST])
        while waiting:
            tried, waiting = waiting[:TOGETHER], waiting[TOGETHER:]
            asked = [
                _Fit(
                    (*current.effects, candidate.variant.effect),
                    current.parameters | candidate.variant.parameters(candidate.sizes),
                    current.fit.offsets,
                    current.segments.starts,
                    is_trial=True,
                )
                for candidate in tried
            ]
            for candidate, found in zip(tried, self._fits(asked, current.simulator), strict=True):
                if found is not None:
                    trials[candidate.name] = found
                    report(f"tried {candidate.name}: {_shown(found)}")
            if trials:
                far = _far_behind(current, closest(list(trials.values())))
                waiting = [c for c in waiting if c.gain * GROWTH > far * ranking[0].gain]
        return trials

    def converged(
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
            _Fit(trial.effects, trial.parameters, trial.fit.offsets, trial.segments.starts)
            for trial in (trials[name] for name in contenders)
        ]
        result = dict(trials)
        fits = self._fits(asked, next(iter(trials.values())).simulator)
        for name, longer in zip(contenders, fits, strict=True):
            result[name] = longer or trials[name]
        return result

    def refitted(
        self, current: Hypothesis, effects: tuple[Effect, ...] | None = None
    ) -> Hypothesis | None:
        """Returns the model with effects, fitted from where a hypothesis is.

        Args:
            current: The hypothesis.
            effects: The effects, its own by default.

        Returns:
            ``None`` if the model cannot be simulated with them.
        """
        chosen = current.effects if effects is None else effects
        kept = {name for effect in chosen for name in effect.parameter_names}
        gone = {name for effect in current.effects for name in effect.parameter_names} - kept
        start = {name: value for name, value in current.parameters.items() if name not in gone}
        asked = _Fit(chosen, start, current.fit.offsets, current.segments.starts)
        (found,) = self._fits([asked], current.simulator)
        return found

    def with_own_starts(self, current: Hypothesis) -> Hypothesis:
        """Returns a hypothesis whose segments start from where it leads itself.

        What its model leaves of the readings tells their states better than the readings alone,
        and how large its offsets come out tells how well.

        Args:
            current: The hypothesis.
        """
        starts = current.estimated_starts(self.rollouts)
        if starts is None:
            return current
        unmoved = torch.zeros_like(current.fit.offsets)
        (found,) = self._fits(
            [_Fit(current.effects, current.parameters, unmoved, starts)], current.simulator
        )
        # Initial states that are told badly may be such that simulations from beside them fail.
        return current if found is None or not found.can_be_linearised else found

    def holding(
        self, current: Hypothesis, held: Sequence[Mapping[str, float]]
    ) -> list[Hypothesis | None]:
        """Returns a hypothesis with some of its parameters held and all others fitted anew.

        Args:
            current: The hypothesis.
            held: For each wanted hypothesis, reference coordinates by site.

        Returns:
            ``None`` in place of those that cannot be simulated.
        """
        effects, start = current.effects, current.parameters
        offsets, starts = current.fit.offsets, current.segments.starts
        asked = [_Fit(effects, start, offsets, starts, held=places) for places in held]
        return list(self._fits(asked, current.simulator))

    def apart_from_waves_in_step(self, tried: Mapping[str, Hypothesis]) -> dict[str, Hypothesis]:
        """Returns the models less those whose last effect is a wave in step with the motion."""
        return {
            name: trial
            for name, trial in tried.items()
            if not keeps_in_step(trial, trial.effects[-1], self.rollouts)
        }

    def without(self, current: Hypothesis, effect: Effect) -> Hypothesis | None:
        """Returns a hypothesis without one of its effects, see :meth:`refitted`."""
        return self.refitted(current, tuple(e for e in current.effects if e.name != effect.name))

    def _fits(self, asked: Sequence[_Fit], simulator: Simulator) -> Iterator[Hypothesis | None]:
        """Yields the model with the effects of each fit, ``None`` where it cannot be simulated."""
        return side_by_side(partial(_fitted, self), asked, num_processes(simulator))


def _fitted(trials: Trials, asked: _Fit) -> Hypothesis | None:
    """Returns a fitted model; ``None`` if it cannot be simulated."""
    try:
        found = fit_hypothesis(
            trials.model,
            trials.rollouts,
            trials.binding,
            effects=asked.effects,
            start=asked.start,
            offsets=asked.offsets,
            starts=asked.starts,
            held=asked.held,
            max_steps=TRIAL_STEPS if asked.is_trial else MAX_STEPS,
            is_rough=asked.is_trial,
        )
    except NpdrError:
        return None
    _ = found.difference  # travels with it, computed side by side
    return found


def _far_behind(current: Hypothesis, best: Hypothesis) -> float:
    """Returns the share of what the best trial explains below which no other is a match for it."""
    scale = best.fit.scale
    explained = best.share * float((current.losses(scale) - best.losses(scale)).sum())
    return 1.0 - PLAINLY / max(explained, PLAINLY)


def _shown(hypothesis: Hypothesis) -> str:
    return ", ".join(
        f"{name} {scale:.3g}"
        for name, scale in zip(
            hypothesis.segments.channel_names, hypothesis.fit.scale.tolist(), strict=True
        )
    )
