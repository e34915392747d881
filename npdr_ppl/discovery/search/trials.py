"""Trials: fits of the original model with different sets of effects to the recording."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, Model, fit_hypothesis
from npdr_ppl.discovery.screening.repetition import keeps_in_step
from npdr_ppl.discovery.screening.screening import Screened
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.search.settings import TRIALS
from npdr_ppl.discovery.side_by_side import num_processes, side_by_side
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.rollouts import Rollouts

__all__ = ["Trials"]


@dataclass(frozen=True)
class _Fit:
    """The arguments of a fit.

    Attributes:
        effects: The effects to add to the model.
        start: Initial guess of the parameters, by site.
        offsets: Initial guess of the offsets of the initial states, ``(S, m)``.
        starts: The segments' initial states.
        is_trial: Whether a short fit with rough steps is enough.
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
        model: The original model.
        rollouts: The recording.
        binding: How it is cut into segments.
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
        """Fits the hypothesis with each candidate of the shortlist, from its linear estimate.

        The best candidates come first. Those whose linear gain is too small to match the best fit
        so far are skipped. Candidates that cannot be simulated are left out.

        Args:
            current: The hypothesis.
            ranking: The candidates, the best first.
            report: Called with a sentence about each candidate.
        """
        trials: dict[str, Hypothesis] = {}
        waiting = list(ranking[: TRIALS.shortlist])
        while waiting:
            tried, waiting = (
                waiting[: TRIALS.candidates_per_decision],
                waiting[TRIALS.candidates_per_decision :],
            )
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
                waiting = [
                    c for c in waiting if c.gain * TRIALS.largest_growth > far * ranking[0].gain
                ]
        return trials

    def converged(
        self, trials: dict[str, Hypothesis], *, done: str | None = None
    ) -> dict[str, Hypothesis]:
        """Fits the best trials until convergence; the others are too far behind.

        Args:
            trials: The model with each of several effects.
            done: Name of the effect whose fit has converged already.
        """
        scale = closest(list(trials.values())).fit.scale
        losses = {name: float(trial.losses(scale).sum()) for name, trial in trials.items()}
        least = min(losses.values())
        contenders = [
            name
            for name in sorted(losses, key=lambda name: losses[name])[: TRIALS.most_converged]
            if name != done
            and losses[name]
            <= least + max(TRIALS.converged_loss, TRIALS.converged_share * abs(least))
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
        """Fits the model with effects, from the parameters of a hypothesis.

        Args:
            current: The hypothesis.
            effects: The effects; those of the hypothesis by default.

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
        """Refits a hypothesis with initial states that are estimated along its own motion.

        With the model's help, the initial states are known better than from the measurements
        alone. The size of the fitted offsets shows how well.

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
        # If initial states are estimated badly, simulations close to them may fail.
        return current if found is None or not found.can_be_linearised else found

    def holding(
        self, current: Hypothesis, held: Sequence[Mapping[str, float]]
    ) -> list[Hypothesis | None]:
        """Refits a hypothesis with some of its parameters held fixed.

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
        """Removes models whose last effect is a wave that is synchronous with the motion."""
        return {
            name: trial
            for name, trial in tried.items()
            if not keeps_in_step(trial, trial.effects[-1], self.rollouts)
        }

    def without(self, current: Hypothesis, effect: Effect) -> Hypothesis | None:
        """Refits a hypothesis without one of its effects; see :meth:`refitted`."""
        return self.refitted(current, tuple(e for e in current.effects if e.name != effect.name))

    def _fits(self, asked: Sequence[_Fit], simulator: Simulator) -> Iterator[Hypothesis | None]:
        """Yields the model with the effects of each fit, ``None`` where it cannot be simulated."""
        return side_by_side(partial(_fitted, self), asked, num_processes(simulator))


def _fitted(trials: Trials, asked: _Fit) -> Hypothesis | None:
    """Fits a model; returns ``None`` if it cannot be simulated."""
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
            max_steps=TRIALS.first_steps if asked.is_trial else TRIALS.most_steps,
            is_rough=asked.is_trial,
        )
    except NpdrError:
        return None
    _ = found.difference  # computed in the parallel process, and sent back with the fit
    return found


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
