"""Discovery: finds which effect a model lacks, adds it and measures whether that helps."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

from torch.distributions import Distribution

from npdr_ppl.discovery.conclusion import Conclusion, conclusion_of, with_law
from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Discovery
from npdr_ppl.discovery.finding_of import findings_of
from npdr_ppl.discovery.hypothesis import Hypothesis, fit_hypothesis
from npdr_ppl.discovery.learning.assumptions import Assumptions
from npdr_ppl.discovery.learning.result import Learned, learn
from npdr_ppl.discovery.predictions import Predictions, held_out_options
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.proof.next_experiment import experiment_for
from npdr_ppl.discovery.proof.residual_map import Spot, worst_windows
from npdr_ppl.discovery.proof.surviving_causes import surviving_causes
from npdr_ppl.discovery.recording_repair import Repair, repair
from npdr_ppl.discovery.screening.encoder_resolution import counts
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.discovery.search.deadline import Deadline
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.limits import limits
from npdr_ppl.discovery.search.parts import PartResult, found_in_parts
from npdr_ppl.discovery.search.prior_ends import PriorEnd, beyond
from npdr_ppl.discovery.search.rounds import Round, Search
from npdr_ppl.discovery.search.settings import SEARCH
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.search_progress import SearchProgress
from npdr_ppl.discovery.segment_options import segment_options, short_segments
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.model import Model
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.jumps import jumps_of
from npdr_ppl.preparation.preparation_summary import PreparationSummary
from npdr_ppl.progress import Reporter, reporter
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.notes import faults_among, remarks_among

__all__ = ["Investigation", "discover"]


COARSE = (
    "The model's integration steps are too coarse for this recording; the revised model takes "
    "finer ones."
)


class Investigation:
    """A model and a recording, examined stage by stage; each stage can be requested alone.

    A stage first runs the earlier stages that it needs. No stage runs twice.

    Args:
        model: A Pyro model with one black-box site, whose simulator has ports.
        rollouts: The recording that is used to find and fit effects.
        holdout: Rollouts that measure the improvement, best with another excitation. They are
            not used to choose or fit effects; if most of the gap on them is left, no effect is
            named.
        options: How the recording is prepared; see :func:`discover`.
        search: Settings of the search.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Attributes:
        recorded: The recording as it was given.
        settings: The settings of the search.
        seconds: Time spent, by stage.
        progress: The line with the progress.

    Raises:
        DataError: The recording is too short, discovery cannot use an option, or ``holdout`` is
            not a ``Rollouts`` or has other channels than the recording.
    """

    def __init__(
        self,
        model: Model,
        rollouts: Rollouts,
        *,
        holdout: Rollouts | None = None,
        options: DataOptions | None = None,
        search: DiscoveryOptions | None = None,
        seed: int = 0,
        progress: bool | Reporter | None = None,
    ) -> None:
        if holdout is not None and not isinstance(holdout, Rollouts):
            raise DataError(
                f"holdout takes rollouts, e.g. rollouts[[3]], but was given {holdout!r}."
            )
        if holdout is not None and holdout.channel_names != rollouts.channel_names:
            raise DataError("The held-out rollouts have other channels than those to fit.")
        self.model = model
        self.recorded = rollouts
        self._recorded_holdout = holdout
        self.settings = search or DiscoveryOptions()
        self.seed = seed
        self.progress = SearchProgress(progress)
        self.seconds = self.progress.seconds
        self._options = options
        self._recorded_options = segment_options(rollouts, options)
        self._deadline = Deadline(self.settings.time_limit)

    @cached_property
    def _repair(self) -> Repair:
        with self.progress.timed("check data"):
            self.progress.say("checking the recording")
            found = repair(
                self.model,
                self.recorded,
                self._recorded_options,
                seed=self.seed,
                report=self.progress.say,
            )
        simulator = found.simulator
        for effect in self.settings.effects or ():
            # Screening skips effects that the simulator cannot have; requested ones raise errors.
            if simulator is not None:
                simulator.with_effects(effect)
            if effect.is_noise:
                raise ModelError(
                    f"{effect.name} only scatters measurements, so no fit can find it; the "
                    "encoder resolution is read from the recording."
                )
        return found

    @property
    def rollouts(self) -> Rollouts:
        """The recording that is searched, repaired where it has faults."""
        return self._repair.rollouts

    @cached_property
    def holdout(self) -> Rollouts | None:
        """The held-out recording, repaired like the other one."""
        recorded = self._recorded_holdout
        return None if recorded is None else self._repair.applied_to(recorded)

    @property
    def problems(self) -> tuple[str, ...]:
        """The faults of the recording and what was done about them, a sentence each."""
        return faults_among(self.rollouts.notes)

    @property
    def remarks(self) -> tuple[str, ...]:
        """How the recording was read, a sentence each; these are no faults."""
        return remarks_among(self.rollouts.notes)

    @cached_property
    def _data_options(self) -> DataOptions:
        """How the repaired recording is cut: an unwrapped angle moves less abruptly."""
        return segment_options(self.rollouts, self._options)

    @cached_property
    def _short_options(self) -> DataOptions:
        return short_segments(self.rollouts, self._options)

    @cached_property
    def _searcher(self) -> Searcher:
        return Searcher(
            self.model,
            self.rollouts,
            self.settings,
            self.progress.say,
            data_options=self._data_options,
            seed=self.seed,
            progress=self.progress,
            deadline=self._deadline,
        )

    @cached_property
    def given(self) -> Hypothesis:
        """The original model, fitted to the recording."""
        searcher = self._searcher
        with self.progress.timed("fit"):
            step = self.progress.stage("fit the original model")
            fitted = searcher.fit_base(
                near=self._repair.parameters, may_be_rough=True, progress=step
            )
        return fitted

    @cached_property
    def start(self) -> Hypothesis:
        """The fitted model, with finer steps and wider priors where its own do not suffice."""
        return self._start[0]

    @cached_property
    def _start(self) -> tuple[Hypothesis, Mapping[str, Distribution]]:
        """The fit that the search begins with, and the model's original priors."""
        given = self.given
        with self.progress.timed("choose steps"):
            self.progress.say("checking integration steps and priors")
            priors = given.segments.prior.distributions
            return self._searcher.settled(given), priors

    @cached_property
    def narrow_priors(self) -> tuple[PriorEnd, ...]:
        """The original priors that do not contain the parameters of the final fit."""
        final = self.search.final
        if not self._searcher.are_priors_widened:
            return ()
        return beyond(self._start[1], final)

    @cached_property
    def where(self) -> list[Spot]:
        """The windows in which the original model fits worst, the worst first."""
        return worst_windows(self.start, self.rollouts)

    @cached_property
    def first(self) -> Round:
        """Alarm and ranking before any effect is added."""
        start = self.start
        with self.progress.timed("screen"):
            return self._searcher.look(start)

    @cached_property
    def search(self) -> Search:
        """The missing effects."""
        first = self.first
        with self.progress.timed("search"):
            return self._searcher.run(first, max_effects=self.settings.max_effects)

    @cached_property
    def found_in(self) -> dict[str, list[PartResult]]:
        """Whether parts of the recording show each effect; empty if that was not asked for."""
        is_asked = self.settings.repeat and self.search.added
        if not is_asked or self.search.has_stopped:
            return {}
        with self.progress.timed("search parts"):
            step = self.progress.stage("seek the effects in parts of the recording")
            return found_in_parts(self.search, self.progress.say, step)

    @cached_property
    def _at_edge(self) -> list[tuple[str, ...]]:
        """For each effect, the shape parameters that have, or may have, an implausible value."""
        search = self.search
        final, explains = search.final, sum(added.share for added in search.missing)
        result = []
        with self.progress.timed("limits"):
            for added in search.added:
                names = list(final.at_edge(added.effect))
                if added.share > VERDICT.minor_share * explains and not search.has_stopped:
                    step = self.progress.stage(f"vary the shape of {added.effect.name}")
                    names += limits(final, added.effect, self._searcher.trials, step)
                result.append(tuple(dict.fromkeys(names)))
        return result

    @cached_property
    def _predictions(self) -> Predictions:
        return Predictions(
            self.given,
            self.search.final,
            self.rollouts,
            self.holdout,
            self._searcher.found_options,
            seed=self.seed,
            progress=self.progress,
            is_approximate=self.search.is_approximate,
            is_late=self.search.has_stopped,
        )

    @cached_property
    def gap(self) -> dict[str, Gap]:
        """Metrics on the held-out recording; empty without one."""
        return self._predictions.gap(self.search.final)

    @cached_property
    def learned(self) -> Learned | None:
        """The laws that the model misses, learned without the catalogue.

        It is ``None`` if none is found. They are learned beside the effects of the search, and
        without them; the better model is taken.
        """
        search, holdout, options = self.search, self.holdout, None
        if holdout is not None:
            options = held_out_options(self._found_short_options, self.rollouts, holdout)
        # With the steps and priors that the search ended with.
        original = search.rounds[0].hypothesis
        begun = [original, *([search.final] if search.added else [])]
        with self.progress.timed("learn"):
            starts = [self._in_short_segments(start) for start in begun]
            found = learn(
                Trials(starts[0].segments),
                starts,
                candidates_at(original, self.settings),
                holdout=holdout,
                options=options,
                assumptions=Assumptions(self.settings.symmetry, self.settings.is_passive),
                report=self.progress.say,
            )
            if found is None or starts[0] is begun[0]:
                return found
            number = [start is found.model.start for start in starts].index(True)
            return found.fitted_along(begun[number], self._searcher.trials)

    @property
    def _found_short_options(self) -> DataOptions:
        before = self._searcher.found_options.commands_before
        return replace(self._short_options, commands_before=before)

    def _in_short_segments(self, hypothesis: Hypothesis) -> Hypothesis:
        """Returns a model that is fitted to short segments; see :func:`short_segments`."""
        if self._short_options == self._data_options:
            return hypothesis
        return fit_hypothesis(
            self.search.rounds[0].hypothesis.model,
            self.rollouts,
            self._found_short_options,
            effects=hypothesis.effects,
            start=hypothesis.parameters,
        )

    @cached_property
    def preparation(self) -> PreparationSummary:
        """What was done to the recording, and with it to the model, before the search."""
        likelihood = self.start.likelihood
        scale = likelihood.fit.scale * math.sqrt(likelihood.variance)
        names = self.start.segments.channel_names
        return PreparationSummary(
            self.rollouts,
            self._searcher.found_options,
            dict(zip(names, scale.tolist(), strict=True)),
            self._searcher.are_steps_coarse,
            likelihood.share,
            tuple(map(str, self.narrow_priors)),
            str(jumps_of(likelihood)),
        )

    def _conclusion(self) -> Conclusion:
        """Returns what follows from the search, and from a learned law if one is needed."""
        search, found_in, predictions = self.search, self.found_in, self._predictions
        parameters = predictions.parameters(search.final)
        effects = findings_of(search, parameters, self._at_edge, found_in)
        found = conclusion_of(search, effects, parameters, self.gap, self.settings)
        needs_law = found.verdict == "unknown" and not search.has_stopped
        if not (self.settings.learn and needs_law) or self.learned is None:
            return found
        return with_law(found, self.learned, predictions, self._searcher.look)

    def conclude(self) -> Discovery:
        """Runs all stages and returns the result."""
        found, predictions = self._conclusion(), self._predictions
        search, final = found.search, found.search.final
        reason = found.reason
        if self.narrow_priors:
            reason = f"{'. '.join(map(str, self.narrow_priors))}. With wider priors: {reason}"
        elif ends := beyond(self._start[1], final):
            reason = " ".join((reason, *(end.decisive for end in ends)))
        if self._searcher.are_steps_coarse:
            reason = f"{reason} {COARSE}"
        with self.progress.timed("next experiment"):
            doubtful, advice = found.doubtful(self.settings), None
            if found.verdict == "ambiguous" and doubtful is not None:
                options = self._searcher.found_options
                advice = experiment_for(search, doubtful, self.rollouts, options)
            causes = surviving_causes(search, doubtful)
            self.progress.finish()
        return Discovery(
            verdict=found.verdict,
            reason=reason,
            preparation=self.preparation,
            problems=self.problems,
            remarks=self.remarks,
            narrow_priors=self.narrow_priors,
            alarm=self.first.alarm,
            remainder=search.rounds[-1].alarm,
            unexplained=found.unexplained,
            where=self.where,
            effects=found.effects,
            ranking=self.first.ranking,
            separation=self.first.separation,
            separation_names=tuple(c.name for c in self.first.ranking[: SEARCH.num_leading]),
            gap=found.gap,
            anew=predictions.anew(final),
            next_experiment=advice,
            causes=causes,
            model=search.rounds[0].hypothesis.model,
            revised=final.model,
            parameters=found.parameters,
            draws=predictions.draws(final),
            counts=counts(final, self.rollouts),
            overlays=predictions.overlays(final, self.start),
            search=search,
            settings=self.settings,
            seed=self.seed,
            seconds=self.seconds,
            learned=found.learned,
        )


def discover(
    model: Model,
    rollouts: Rollouts,
    *,
    holdout: Rollouts | None = None,
    options: DataOptions | None = None,
    search: DiscoveryOptions | None = None,
    seed: int = 0,
    progress: bool | Reporter | None = None,
) -> Discovery:
    """Finds the effects that a model lacks, adds them and measures the improvement.

    Args:
        model: A Pyro model with one black-box site, whose simulator has ports.
        rollouts: The recording that is used to find and fit effects.
        holdout: Rollouts that measure the improvement, best with another excitation. They are
            not used to choose or fit effects; if most of the gap on them is left, no effect is
            named.
        options: How the recording is prepared. Discovery estimates initial states and noise, and
            compares trajectories themselves: ``initial_state`` and ``noise`` must have their
            defaults, ``segment_length`` must not be ``None``, and ``embedding`` has no effect.
        search: Settings of the search.
        seed: Seed of everything random.
        progress: Whether to show progress, or where; ``None`` shows it on a terminal.

    Raises:
        DataError: The recording is too short or does not fit the model, or discovery cannot use
            an option.
        ModelError: The model cannot be inferred, or no fit can find a requested effect.
    """
    with reporter(progress) as report:
        return Investigation(
            model,
            rollouts,
            holdout=holdout,
            options=options,
            search=search,
            seed=seed,
            progress=report,
        ).conclude()
