"""What fitted models predict, beside the recording that was searched and on held-out rollouts."""

from dataclasses import replace

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.estimated_anew import EstimatedAnew, estimated_anew
from npdr_ppl.discovery.proof.held_out_gap import Gap, prove
from npdr_ppl.discovery.proof.overlays import Overlays, overlay
from npdr_ppl.discovery.proof.parameter_intervals import (
    Draws,
    Estimate,
    estimates,
    posterior_draws,
    quick_draws,
)
from npdr_ppl.discovery.search_progress import SearchProgress
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts

__all__ = ["Predictions", "held_out_options"]


class Predictions:
    """Draws of fitted models' posteriors, and what models predict with them.

    Draws, and parameters that are estimated anew, are computed once for each model.

    Args:
        given: The original model, fitted.
        revised: The model with the effects of the search, fitted.
        rollouts: The recording that was searched.
        holdout: The held-out recording, if there is one.
        options: How the recording that was searched is prepared.
        seed: Seed of everything random.
        progress: Shows the stages, and records how long they take.
        is_approximate: Whether the revised model leaves something unexplained.
        is_late: Whether the search was ended early, so that nothing further may take long.
    """

    def __init__(
        self,
        given: Hypothesis,
        revised: Hypothesis,
        rollouts: Rollouts,
        holdout: Rollouts | None,
        options: DataOptions,
        *,
        seed: int,
        progress: SearchProgress,
        is_approximate: bool,
        is_late: bool,
    ) -> None:
        self._given = given
        self._rollouts = rollouts
        self._holdout = holdout
        self._options = options
        self._seed = seed
        self._progress = progress
        self._is_late = is_late
        # A model that lacks effects predicts; its intervals may be wrong anyway.
        self._lacks_effects = [given] if given is not revised else []
        self._lacks_effects += [revised] if is_approximate else []
        self._drawn: list[tuple[Hypothesis, Draws]] = []
        self._anew: list[tuple[Hypothesis, EstimatedAnew | None]] = []

    def draws(self, hypothesis: Hypothesis) -> Draws:
        """Returns draws of a model's posterior."""
        for known, draws in self._drawn:
            if known is hypothesis:
                return draws
        with self._progress.timed(f"posterior {len(self._drawn) + 1}"):
            self._progress.say("drawing parameters")
            if self._is_late:
                draws = quick_draws(hypothesis, seed=self._seed)
            else:
                is_rough = any(hypothesis is one for one in self._lacks_effects)
                draws = posterior_draws(hypothesis, seed=self._seed, is_rough=is_rough)
        self._drawn.append((hypothesis, draws))
        return draws

    def parameters(self, hypothesis: Hypothesis) -> dict[str, Estimate]:
        """Returns estimates of all parameters of a model, by site."""
        return estimates(hypothesis, self.draws(hypothesis), _units(hypothesis))

    def gap(self, final: Hypothesis) -> dict[str, Gap]:
        """Returns the metrics of a final model on the held-out recording; empty without one."""
        if self._holdout is None:
            return {}
        draws_before, draws_after = self.draws(self._given), self.draws(final)
        with self._progress.timed("prove"):
            self._progress.say("predicting the held-out recording")
            return prove(
                self._given,
                final,
                self._holdout,
                held_out_options(self._options, self._rollouts, self._holdout),
                draws_before=draws_before,
                draws_after=draws_after,
                seed=self._seed,
                anew=self.anew(final),
            )

    def anew(self, final: Hypothesis) -> EstimatedAnew | None:
        """Returns what belongs to a recording in a final model, as in the held-out recording."""
        if self._holdout is None:
            return None
        for known, anew in self._anew:
            if known is final:
                return anew
        options = held_out_options(self._options, self._rollouts, self._holdout)
        self._anew.append((final, estimated_anew(final, self._holdout, options)))
        return self._anew[-1][1]

    def overlays(self, final: Hypothesis, searched: Hypothesis) -> Overlays:
        """Returns the held-out rollouts, or else the recording, and simulations of them.

        Args:
            final: The final model.
            searched: The original model as the search began.
        """
        with self._progress.timed("simulate"):
            self._progress.say("simulating the recording")
            return overlay(
                self._given,
                final,
                searched,
                self._rollouts if self._holdout is None else self._holdout,
                self._options,
                is_held_out=self._holdout is not None,
                anew=self.anew(final),
            )


def held_out_options(options: DataOptions, rollouts: Rollouts, holdout: Rollouts) -> DataOptions:
    """Returns options for segments of the same duration at the held-out sampling rate.

    Args:
        options: How the recording that is searched is prepared.
        rollouts: This recording.
        holdout: The held-out recording.
    """
    length = options.steps(rollouts)
    assert length is not None
    steps = round(length * rollouts.time_step / holdout.time_step)
    return replace(options, segment_length=max(2, steps))


def _units(hypothesis: Hypothesis) -> dict[str, str]:
    simulator = hypothesis.simulator
    units = {parameter.name: parameter.unit for parameter in simulator.parameters}
    for effect in simulator.effects:
        own = effect.units(simulator.port(effect.port))
        units |= {f"{effect.name}.{name}": unit for name, unit in own.items()}
    return units
