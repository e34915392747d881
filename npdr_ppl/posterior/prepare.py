"""The preparation of a recording, with which ``fit``, ``compare`` and ``train`` begin.

It estimates the initial states and their errors, finds the model's closest fit, refines
integration steps that are too coarse, estimates noise that the model does not declare, and chooses
features. ``discover`` shares its first part, the fit in ``discovery/search/original_model.py``.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.discovery_options import DiscoveryOptions
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.recording_repair import Repair, repair
from npdr_ppl.discovery.screening.alarm import Alarm
from npdr_ppl.discovery.search.base_fit import BaseFit
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.prior_ends import PriorEnd, beyond
from npdr_ppl.embeddings import Embedding
from npdr_ppl.embeddings.score import Score
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.preparation.binding import BoundModel, bind
from npdr_ppl.preparation.closest_fit import ClosestFit, closest_fit
from npdr_ppl.preparation.data_options import FEWEST_SEGMENTS, PLAIN_FEATURES, DataOptions
from npdr_ppl.preparation.initial_states import InitialStates
from npdr_ppl.preparation.jumps import jumps_of
from npdr_ppl.preparation.preparation_summary import PreparationSummary
from npdr_ppl.preparation.segment_fit import SegmentFit, fit_segments
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.segment_model import SegmentModel, has_closest_fit
from npdr_ppl.preparation.settings import PRIOR_SEARCH
from npdr_ppl.progress import Step
from npdr_ppl.rollouts import Rollouts

__all__ = ["Preparation", "held_out", "prepare", "score_embedding"]

MARGIN = 0.1
"""Least standard deviation of the neighbourhood of a fit, in standard deviations of the prior."""


@dataclass(frozen=True)
class Preparation:
    """A model and a recording, ready for inference.

    Attributes:
        model: The model with noise, and with finer steps if its own are too coarse.
        plain_model: The same model without estimated noise.
        repair: What was changed in the recording before.
        options: The options, with features that can be applied.
        noise: Estimated standard deviation by channel, in its unit; ``None`` if the model keeps
            its own.
        noise_of_sensors: The same for all sensors; negligible for those that were not measured.
        are_steps_coarse: Whether the model's own integration steps are too coarse.
        hypothesis: The closest fit, if initial states are uncertain and the simulator is
            deterministic; otherwise ``None``, as are the attributes below.
        likelihood: The recording's likelihood.
        widest: The closest fit with wider priors, if it lies at the end of a prior; otherwise the
            same as ``hypothesis``.
        ends: These ends of priors.
        searcher: Discovery's search.
        closest: The closest fit if initial states are taken as true.
    """

    model: Model
    plain_model: Callable[..., Any]
    repair: Repair
    options: DataOptions
    noise: dict[str, float] | None
    noise_of_sensors: dict[str, float] | None = None
    are_steps_coarse: bool = False
    hypothesis: Hypothesis | None = None
    likelihood: SegmentLikelihood | None = None
    widest: Hypothesis | None = None
    ends: tuple[PriorEnd, ...] = ()
    searcher: Searcher | None = None
    closest: ClosestFit | None = None
    _bound: dict[str, BoundModel] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def rollouts(self) -> Rollouts:
        """The recording that is fitted."""
        return self.repair.rollouts

    def bound(self, device: str | torch.device = "cpu") -> BoundModel:
        """Returns the model bound to the recording, the input of every backend.

        Every later call with the same device returns the same object.

        Args:
            device: Where trajectories are simulated.

        Raises:
            DataError: The recording does not fit the model.
        """
        if str(device) not in self._bound:
            self._bound[str(device)] = bind(
                self.model,
                self.rollouts,
                self.options,
                device,
                starts=self.starts,
                likelihood=self.likelihood,
            )
        return self._bound[str(device)]

    @property
    def starts(self) -> InitialStates | None:
        """The segments' estimated initial states."""
        return None if self.hypothesis is None else self.hypothesis.segments.starts

    @property
    def alarm(self) -> Alarm | None:
        """Discovery's test of whether the recording shows anything that no parameters explain.

        It is made at the closest fit with wider priors, if the fit lies at the end of a prior.
        ``None`` if there are too few segments for the test.
        """
        if self.searcher is None or self.widest is None:
            return None
        if self.widest.segments.inputs.num_segments < FEWEST_SEGMENTS:
            return None
        # One look costs a few seconds; to start processes would cost more.
        return self.searcher.look(self.widest, number=1).alarm

    @property
    def misfit(self) -> float:
        """Residuals at the closest fit relative to the declared noise; 1 if none is declared."""
        if self.likelihood is None or not self.likelihood.is_noise_declared:
            return 1.0
        return math.sqrt(self.likelihood.misfit)

    def with_features(self, embedding: str | Embedding | None) -> "Preparation":
        """Returns the preparation with other features; ``"score"`` is made at the closest fit."""
        if embedding == "score" and self.likelihood is not None:
            embedding = score_embedding(self.likelihood)
        return replace(self, options=replace(self.options, embedding=embedding))

    def neighbourhood(self) -> GaussianMixture | None:
        """Returns a normal density around the closest fit, wider than the posterior should be.

        Its covariance is the one of Laplace's approximation, plus a variance of ``MARGIN`` squared
        in every direction, because the model is not linear and may lack effects.
        """
        if self.likelihood is None:
            return None
        information = self.likelihood.information()
        eye = torch.eye(len(information), dtype=torch.float64)
        covariance = torch.linalg.inv(information + eye) + MARGIN**2 * eye
        one = torch.ones(1, dtype=torch.float64)
        return GaussianMixture.from_moments(one, self.likelihood.fit.z[None], covariance[None])

    @property
    def summary(self) -> PreparationSummary:
        """What was done, for a run's JSON."""
        return PreparationSummary(
            self.rollouts,
            self.options,
            self.noise,
            self.are_steps_coarse,
            None if self.likelihood is None else self.likelihood.share,
            tuple(map(str, self.ends)),
            self._jumps,
        )

    @cached_property
    def _jumps(self) -> str:
        return "" if self.likelihood is None else str(jumps_of(self.likelihood))


def prepare(
    model: Model,
    rollouts: Rollouts,
    options: DataOptions,
    *,
    near: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    progress: Step | None = None,
) -> Preparation:
    """Prepares a model and a recording for inference.

    Args:
        model: The Pyro model.
        rollouts: The recording to be fitted; never the held-out one.
        options: How the data are prepared.
        near: Parameters near which the closest fit is known to be.
        seed: Seed of the search.
        progress: Called with the fraction done, ``None`` where it is not known, and a short
            status.

    Raises:
        DataError: No parameters can be simulated along the recording, or the data do not fit.
    """
    step = progress or (lambda fraction, status: None)
    step(None, "check the recording")
    repaired = repair(
        model, rollouts, options, seed=seed, report=lambda status: step(None, status)
    )
    rollouts = repaired.rollouts
    prior = Prior(model, (options.with_certain_start().inputs(rollouts),))
    is_declared = any(box.noise is not None for box in prior.black_boxes.values())
    if options.initial_state != "uncertain" or not has_closest_fit(prior):
        return _with_certain_starts(
            model, repaired, options, is_declared or options.noise == "model", seed, progress
        )
    length = options.steps(rollouts) or max(rollouts.lengths)
    data_options = replace(options, embedding=None, segment_length=length)
    searcher = Searcher(
        model,
        rollouts,
        DiscoveryOptions(),
        data_options=data_options,
        seed=seed,
    )
    closest = searcher.fit_base(
        near=near or repaired.parameters, may_be_rough=True, progress=progress
    )
    step(None, "compare with finer integration steps")
    finer = searcher.with_finer_steps(closest, is_rough=True)
    converged = searcher.converged(finer)
    closest = searcher.with_likelier_commands_before(converged)
    finer = finer if closest is converged else closest
    base = BaseFit(searcher.base, closest, searcher.are_steps_coarse)
    step(None, "check the priors")
    wider = searcher.with_wider_priors(finer)
    if wider is finer:
        wider = closest
    else:
        # A narrow prior can hide which commands are likelier.
        wider = searcher.with_likelier_commands_before(wider)
        closest = searcher.under_commands_found(closest)
        base = replace(base, segments=closest.segments, hypothesis=closest)
    ends = ()
    if searcher.are_priors_widened:
        ends = beyond(base.hypothesis.segments.prior.distributions, wider)
    step(None, "estimate the noise")
    likelihood = _likelihood(base, is_declared)
    estimated = every = None
    if options.noise == "auto" and not is_declared:
        scale = likelihood.fit.scale * math.sqrt(likelihood.variance)
        segments = base.hypothesis.segments
        estimated = dict(zip(segments.channel_names, scale.tolist(), strict=True))
        absent = PRIOR_SEARCH.negligible_deviation
        every = {name: estimated.get(name, absent) for name in segments.sensor_names}
    model = base.segments.model
    found = Preparation(
        model if every is None else with_noise(model, every),
        model,
        repaired,
        replace(searcher.found_options, embedding=options.embedding),
        estimated,
        every,
        base.are_steps_coarse,
        base.hypothesis,
        likelihood,
        wider,
        ends,
        searcher,
    )
    return found.with_features(options.embedding)


def held_out(prepared: Preparation, rollouts: Rollouts) -> SegmentLikelihood | None:
    """Returns the likelihood of another recording, on which a posterior is evaluated.

    Scale and share of independent measurements are those of the recording that was fitted; initial
    states are estimated along the motion that was found there.

    Args:
        prepared: The recording that was fitted.
        rollouts: The other recording, repaired.

    Returns:
        ``None`` where the recording that was fitted has no likelihood either.
    """
    fitted = prepared.likelihood
    if fitted is None:
        return None
    z, scale = fitted.fit.z, fitted.fit.scale
    data_options = replace(prepared.options, embedding=None, precision="float64")
    segments = SegmentModel(prepared.plain_model, rollouts, data_options)
    starts = segments.estimated_starts(z, scale)
    if starts is not None:
        segments = segments.starting_from(starts)
    fit = SegmentFit(z, segments.no_offsets, scale * fitted.variance**0.5)
    now = segments.linearise(z, fit.offsets, fit.scale)
    # The scale is that of the noise, as if it had been declared.
    return SegmentLikelihood(segments, fit, now, fitted.share, is_noise_declared=True)


def score_embedding(likelihood: SegmentLikelihood) -> Score:
    """Returns the embedding that compresses trajectories into their score at the closest fit.

    Initial states are integrated out.
    """
    segments, fit = likelihood.segments, likelihood.fit
    now = likelihood.linearisation
    # A parameter that does nothing has a score of zero.
    deviation = now.information().diagonal().sqrt().clamp_min(1e-12)
    weights = now.weights().unflatten(1, segments.observed.shape[1:]) / fit.scale[:, None]
    mean = segments.simulate(fit.z[None], fit.offsets[None])[0]
    return Score(mean, weights, deviation)


def _with_certain_starts(
    model: Model,
    repaired: Repair,
    options: DataOptions,
    keeps_noise: bool,
    seed: int,
    progress: Step | None,
) -> Preparation:
    """Prepares a recording for which no fit with uncertain initial states is possible."""
    if options.embedding == "score":
        options = replace(options, embedding=PLAIN_FEATURES)
    if keeps_noise:
        return Preparation(model, model, repaired, options, None)
    found = closest_fit(model, repaired.rollouts, options, seed=seed, progress=progress)
    noisy = with_noise(model, found.noise)
    return Preparation(noisy, model, repaired, options, found.scale, found.noise, closest=found)


def _likelihood(base: BaseFit, is_declared: bool) -> SegmentLikelihood:
    """Returns the recording's likelihood, with the model's declared noise if there is one."""
    found = base.hypothesis
    scale = _declared_scale(base) if is_declared else None
    if scale is None:
        return found.likelihood
    fit = fit_segments(found.segments, found.fit.z, offsets=found.fit.offsets, scale=scale)
    now = found.segments.linearise(fit.z, fit.offsets, scale)
    fit = replace(fit, difference=None)  # of a long recording it is large
    return SegmentLikelihood(found.segments, fit, now, found.share, is_noise_declared=True)


def _declared_scale(base: BaseFit) -> Tensor | None:
    """Returns the declared standard deviation of each measured channel, ``(C,)``.

    ``None`` where the noise is a distribution of another kind than independent normal errors.
    """
    segments, z = base.hypothesis.segments, base.hypothesis.fit.z
    boxes = Prior(base.segments.model, (segments.inputs,)).black_boxes_at(z[None])
    noise = next(iter(boxes.values())).noise
    if noise is None or callable(noise):
        return None
    names = segments.channel_names
    values = (
        [noise[name] for name in names] if isinstance(noise, Mapping) else [noise] * len(names)
    )
    return torch.stack([torch.as_tensor(v).double().flatten()[0] for v in values])
