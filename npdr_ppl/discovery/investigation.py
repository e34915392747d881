"""Discovery: finds which effect a model lacks, adds it and measures whether that helps."""

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property

from torch.distributions import Distribution

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.discovery_result import Discovery
from npdr_ppl.discovery.finding_of import finding_of
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.learning.assumptions import Assumptions
from npdr_ppl.discovery.learning.result import Learned, learn
from npdr_ppl.discovery.proof.estimated_anew import EstimatedAnew, estimated_anew
from npdr_ppl.discovery.proof.held_out_gap import Gap, prove
from npdr_ppl.discovery.proof.next_experiment import NextExperiment, next_experiment
from npdr_ppl.discovery.proof.overlays import Overlays, overlay
from npdr_ppl.discovery.proof.parameter_intervals import (
    Draws,
    estimates,
    posterior_draws,
)
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
from npdr_ppl.discovery.search.repeatability import repetitions
from npdr_ppl.discovery.search.rounds import Round, Search, explained
from npdr_ppl.discovery.search.settings import EVIDENCE, SEARCH
from npdr_ppl.discovery.search_progress import SearchProgress
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.discovery.settings import VERDICT
from npdr_ppl.discovery.verdict import judge, most_doubtful
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.model import Model
from npdr_ppl.preparation.data_options import DataOptions
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
        self.seconds: dict[str, float] = {}
        self.progress = SearchProgress(progress)
        self._data_options = segment_options(rollouts, options)
        self._deadline = Deadline(self.settings.time_limit)
        self._drawn: list[tuple[Hypothesis, Draws]] = []
        self._anew: list[tuple[Hypothesis, EstimatedAnew | None]] = []

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Shows progress inside the block, and records how long it takes."""
        begin = time.monotonic()
        with self.progress.shown():
            yield
        self.seconds[name] = time.monotonic() - begin

    @cached_property
    def _repair(self) -> Repair:
        with self._stage("check data"):
            self.progress.say("checking the recording")
            found = repair(self.model, self.recorded, self._data_options, report=self.progress.say)
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
        with self._stage("fit"):
            step = self.progress.stage("fit the original model")
            fitted = searcher.fit_base(may_be_rough=True, progress=step)
        return fitted

    @cached_property
    def start(self) -> Hypothesis:
        """The fitted model, with finer steps and wider priors where its own do not suffice."""
        return self._start[0]

    @cached_property
    def _start(self) -> tuple[Hypothesis, Mapping[str, Distribution]]:
        """The fit that the search begins with, and the model's original priors."""
        given = self.given
        with self._stage("choose steps"):
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
        with self._stage("screen"):
            return self._searcher.look(start)

    @cached_property
    def search(self) -> Search:
        """The missing effects."""
        first = self.first
        with self._stage("search"):
            return self._searcher.run(first, max_effects=self.settings.max_effects)

    @cached_property
    def found_in(self) -> dict[str, list[PartResult]]:
        """Whether parts of the recording show each effect; empty if that was not asked for."""
        is_asked = self.settings.repeat and self.search.added
        if not is_asked or self.search.has_stopped:
            return {}
        with self._stage("search parts"):
            step = self.progress.stage("seek the effects in parts of the recording")
            return found_in_parts(self.search, self.progress.say, step)

    @cached_property
    def _at_edge(self) -> list[tuple[str, ...]]:
        """For each effect, the shape parameters that have, or may have, an implausible value."""
        search = self.search
        final, explains = search.final, sum(added.share for added in search.added)
        result = []
        with self._stage("limits"):
            for added in search.added:
                names = list(final.at_edge(added.effect))
                if added.share > VERDICT.minor_share * explains:
                    step = self.progress.stage(f"vary the shape of {added.effect.name}")
                    names += limits(final, added.effect, self._searcher.trials, step)
                result.append(tuple(dict.fromkeys(names)))
        return result

    def _draws(self, hypothesis: Hypothesis) -> Draws:
        """Returns draws of a hypothesis's posterior."""
        for known, draws in self._drawn:
            if known is hypothesis:
                return draws
        with self._stage(f"posterior {len(self._drawn) + 1}"):
            self.progress.say("drawing parameters")
            # The original model predicts; where it lacks effects, its intervals are wrong.
            is_rough = hypothesis is self.given and bool(hypothesis is not self.search.final)
            draws = posterior_draws(hypothesis, seed=self.seed, is_rough=is_rough)
        self._drawn.append((hypothesis, draws))
        return draws

    @cached_property
    def gap(self) -> dict[str, Gap]:
        """Metrics on the held-out recording; empty without one."""
        return self._gap_of(self.search.final)

    def _gap_of(self, final: Hypothesis) -> dict[str, Gap]:
        """Returns the metrics of a revised model on the held-out recording."""
        if self.holdout is None:
            return {}
        given = self.given
        draws_before, draws_after = self._draws(given), self._draws(final)
        with self._stage("prove"):
            self.progress.say("predicting the held-out recording")
            data_options = _like(self._data_options, self.rollouts, self.holdout)
            return prove(
                given,
                final,
                self.holdout,
                data_options,
                draws_before=draws_before,
                draws_after=draws_after,
                seed=self.seed,
                anew=self._anew_of(final),
            )

    def _anew_of(self, final: Hypothesis) -> EstimatedAnew | None:
        """Returns what belongs to a recording in a revised model, as in the held-out recording."""
        if self.holdout is None:
            return None
        for known, anew in self._anew:
            if known is final:
                return anew
        data_options = _like(self._data_options, self.rollouts, self.holdout)
        self._anew.append((final, estimated_anew(final, self.holdout, data_options)))
        return self._anew[-1][1]

    @cached_property
    def learned(self) -> Learned | None:
        """The laws that the model misses, learned without the catalogue.

        It is ``None`` if none is found. They are learned beside the effects of the search, and
        without them; the better model is taken.
        """
        search, holdout, options = self.search, self.holdout, None
        if holdout is not None:
            options = _like(self._data_options, self.rollouts, holdout)
        starts = [self.start, *([search.final] if search.added else [])]
        with self._stage("learn"):
            return learn(
                self._searcher.trials,
                starts,
                candidates_at(self.start, self.settings),
                holdout=holdout,
                options=options,
                assumptions=Assumptions(self.settings.symmetry, self.settings.is_passive),
                report=self.progress.say,
            )

    def _overlays(self, final: Hypothesis) -> Overlays:
        """Returns the held-out rollouts, or else the recording, and simulations of them."""
        shown = self.rollouts if self.holdout is None else self.holdout
        with self._stage("simulate"):
            self.progress.say("simulating the recording")
            return overlay(
                self.given,
                final,
                self.start,
                shown,
                self._data_options,
                is_held_out=self.holdout is not None,
                anew=self._anew_of(final),
            )

    def _advice(self, name: str) -> NextExperiment | None:
        """Returns the experiment that would separate the likeliest alternatives to an effect."""
        search = self.search
        added = next(a for a in search.added if a.effect.name == name)
        likeliest = sorted(added.alternatives, key=lambda n: added.alternatives[n], reverse=True)
        names = [
            n
            for n in likeliest[: VERDICT.most_separated]
            if added.alternatives[n] >= EVIDENCE.least_probability
        ]
        alternatives = [search.trials[added.place, n] for n in names]
        if len(alternatives) < 2:
            return None
        ids = {name.rsplit(".", 1)[1] for name in names}
        classes = [g for g in added.effect.equivalence if len(ids & set(g.members)) > 1]
        return next_experiment(alternatives, self.rollouts, self._data_options, classes)

    @property
    def preparation(self) -> PreparationSummary:
        """What was done to the recording, and with it to the model, before the search."""
        likelihood = self.start.likelihood
        scale = likelihood.fit.scale * math.sqrt(likelihood.variance)
        names = self.start.segments.channel_names
        return PreparationSummary(
            self.rollouts,
            self._data_options,
            dict(zip(names, scale.tolist(), strict=True)),
            self._searcher.are_steps_coarse,
            likelihood.share,
            tuple(map(str, self.narrow_priors)),
        )

    def conclude(self) -> Discovery:
        """Runs all stages and returns the result."""
        search, found_in = self.search, self.found_in
        final = search.final
        unexplained = _unexplained(search)
        every = estimates(final, self._draws(final), _units(final))
        again = repetitions(final)
        effects = [
            finding_of(
                added,
                search,
                every,
                at_edge,
                again.get(added.effect.name),
                found_in.get(added.effect.name, []),
            )
            for added, at_edge in zip(search.added, self._at_edge, strict=True)
        ]
        effects.sort(key=lambda found: found.share, reverse=True)
        gap = self.gap
        verdict, reason = judge(search, effects, unexplained, gap, self.settings)
        learned: Learned | None = None
        if self.settings.learn and verdict == "unknown" and not search.has_stopped:
            learned = self.learned
        if learned is not None and learned.is_offered:
            proven = self._gap_of(learned.model.hypothesis)
            if proven and proven["rmse"].has_grown:
                learned = learned.withdrawn(
                    f"{learned.reason} But the error on the held-out rollouts grows from "
                    f"{proven['rmse'].before:.3g} to {proven['rmse'].after:.3g}."
                )
            else:
                verdict, gap = "learned", proven
                left = self._searcher.look(learned.model.hypothesis)
                search = replace(
                    search, rounds=[*search.rounds, left], final=learned.model.hypothesis
                )
                unexplained = _unexplained(search)
                final = learned.model.hypothesis
                reason = f"No effect that was searched explains the recording. {learned.reason}"
                every = estimates(final, self._draws(final), _units(final))
                kept = {effect.name for effect in learned.model.start.effects}
                effects = [found for found in effects if found.effect.name in kept]
        if self.narrow_priors:
            reason = f"{'. '.join(map(str, self.narrow_priors))}. With wider priors: {reason}"
        if self._searcher.are_steps_coarse:
            reason = f"{reason} {COARSE}"
        with self._stage("next experiment"):
            advice, doubtful = None, None
            if verdict == "ambiguous":
                doubtful = most_doubtful(effects, self.settings).effect.name
                advice = self._advice(doubtful)
            elif verdict == "unknown" and effects:
                doubtful = effects[0].effect.name
            causes = surviving_causes(search, doubtful)
            self.progress.finish()
        return Discovery(
            verdict=verdict,
            reason=reason,
            preparation=self.preparation,
            problems=self.problems,
            remarks=self.remarks,
            narrow_priors=self.narrow_priors,
            alarm=self.first.alarm,
            remainder=search.rounds[-1].alarm,
            unexplained=unexplained,
            where=self.where,
            effects=effects,
            ranking=self.first.ranking,
            separation=self.first.separation,
            separation_names=tuple(c.name for c in self.first.ranking[: SEARCH.num_leading]),
            gap=gap,
            anew=self._anew_of(final),
            next_experiment=advice,
            causes=causes,
            model=search.rounds[0].hypothesis.model,
            revised=final.model,
            parameters=every,
            draws=self._draws(final),
            counts=counts(final, self.rollouts),
            overlays=self._overlays(final),
            search=search,
            settings=self.settings,
            seed=self.seed,
            seconds=self.seconds,
            learned=learned,
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


def _unexplained(search: Search) -> float:
    """Returns the share of the misfit that a further law could explain in the final model."""
    done = explained(search.rounds[0].hypothesis, search.final)
    left = search.rounds[-1].alarm.gain
    return left / max(left + done, 1e-12)


def _units(hypothesis: Hypothesis) -> dict[str, str]:
    simulator = hypothesis.simulator
    units = {parameter.name: parameter.unit for parameter in simulator.parameters}
    for effect in simulator.effects:
        own = effect.units(simulator.port(effect.port))
        units |= {f"{effect.name}.{name}": unit for name, unit in own.items()}
    return units


def _like(data_options: DataOptions, rollouts: Rollouts, holdout: Rollouts) -> DataOptions:
    """Returns options for segments of the same duration at the held-out sampling rate."""
    length = data_options.steps(rollouts)
    assert length is not None
    steps = round(length * rollouts.time_step / holdout.time_step)
    return replace(data_options, segment_length=max(2, steps))
