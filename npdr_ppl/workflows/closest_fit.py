"""How near a model can come to a recording, and what inference takes from that.

A simulator that lacks an effect never reproduces a recording exactly; without noise of the size of
what is left, the recording is unlike every simulation and a likelihood-free posterior is
extrapolation. The closest fit gives the size of that noise, and a point around which trajectories
can be compressed into their score.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from npdr_ppl.embeddings.score import Score
from npdr_ppl.errors import DataError
from npdr_ppl.inference.base import Density
from npdr_ppl.inference.gaussian_mixture import GaussianMixture
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.evaluation import declares_noise
from npdr_ppl.workflows.progress import Step
from npdr_ppl.workflows.segment_fit import SegmentFit, fit_segments
from npdr_ppl.workflows.segment_model import Linearisation, SegmentModel

__all__ = ["ClosestFit", "Prepared", "closest_fit", "prepare", "score_embedding"]

ITERATIONS, POPULATION = 6, 200
"""Of the cross-entropy search: enough to find the valley, not its bottom."""

MARGIN = 0.1
"""Least standard deviation of the neighbourhood of a fit, in the prior's."""

NEGLIGIBLE = 1e-9
"""Standard deviation that no unit makes large."""


@dataclass(frozen=True)
class ClosestFit:
    """How near a model can come to a recording.

    Attributes:
        segments: The model along the recording.
        fit: Parameters and initial states that leave least.
    """

    segments: SegmentModel
    fit: SegmentFit

    @property
    def scale(self) -> dict[str, float]:
        """Root-mean-square residual by channel, in the channel's unit."""
        return dict(zip(self.segments.channel_names, self.fit.scale.tolist(), strict=True))

    @cached_property
    def linearisation(self) -> Linearisation:
        """Residuals and derivatives at the fit."""
        return self.segments.linearise(self.fit.z, self.fit.offsets, self.fit.scale)

    def neighbourhood(self) -> GaussianMixture:
        """Returns a normal density around the fit that is wider than the posterior should be.

        Its covariance is that of Laplace's approximation, and ``MARGIN`` of the prior's standard
        deviations more in every direction, for what is not linear and for what the model lacks.
        """
        information = self.linearisation.information()
        eye = torch.eye(len(information), dtype=torch.float64)
        covariance = torch.linalg.inv(information + eye) + MARGIN**2 * eye
        one = torch.ones(1, dtype=torch.float64)
        return GaussianMixture.from_moments(one, self.fit.z[None], covariance[None])

    @property
    def noise(self) -> dict[str, float]:
        """The scale as a site's noise; channels that were not measured get next to none."""
        return {name: self.scale.get(name, NEGLIGIBLE) for name in self.segments.sensor_names}

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The parameters, ``(1,) + site.shape`` by latent site."""
        return self.segments.prior.to_parameters(self.fit.z[None])


@dataclass(frozen=True)
class Prepared:
    """A model and options that inference can work with.

    Attributes:
        model: The model, with noise.
        options: The options, with an embedding that can be applied.
        noise: Estimated standard deviation by channel, in its unit; ``None`` if the model keeps
            its own.
        neighbourhood: Density around the closest fit, if one was asked for.
    """

    model: Callable[..., Any]
    options: BindingOptions
    noise: dict[str, float] | None
    neighbourhood: Density | None = None


def prepare(
    model: Callable[..., Any],
    rollouts: Rollouts,
    options: BindingOptions,
    *,
    noise: Literal["auto", "model"] = "auto",
    wants_neighbourhood: bool = False,
    near: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    progress: Step | None = None,
) -> Prepared:
    """Gives a model the noise, and the embedding the point of expansion, that they lack.

    Args:
        model: The Pyro model.
        rollouts: The recording to be fitted; never the held-out one.
        options: Segments, initial states, embedding and precision.
        noise: ``"auto"`` gives a model without noise that of the closest fit; ``"model"`` takes
            it as it is.
        wants_neighbourhood: Whether inference is to start near the closest fit.
        near: Parameters near which the closest fit is known to be.
        seed: Seed of the search.
        progress: Called with the fraction done and a short status.
    """
    lacks_noise = noise == "auto" and not declares_noise(model, rollouts, options)
    lacks_point = options.embedding == "score"
    if not (lacks_noise or lacks_point or wants_neighbourhood):
        return Prepared(model, options, None)
    found = closest_fit(model, rollouts, options, near=near, seed=seed, progress=progress)
    if lacks_point:
        options = replace(options, embedding=score_embedding(found))
    return Prepared(
        with_noise(model, found.noise) if lacks_noise else model,
        options,
        found.scale if lacks_noise else None,
        found.neighbourhood() if wants_neighbourhood else None,
    )


def closest_fit(
    model: Callable[..., Any],
    rollouts: Rollouts,
    options: BindingOptions,
    *,
    near: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    progress: Step | None = None,
) -> ClosestFit:
    """Searches for the parameters of least residual along a recording.

    A short cross-entropy search (Rubinstein 1999) over the prior's reference coordinates finds the
    valley. Where initial states are uncertain, Gauss-Newton steps go on from there, in which the
    initial states are fitted too; see :mod:`npdr_ppl.workflows.segment_fit`. Where they are taken
    as true they are not: what their errors leave belongs to the noise.

    Args:
        model: The Pyro model.
        rollouts: The recording to be fitted; never the held-out one.
        options: Segments, initial states and precision.
        near: Parameters by latent site, from which to go on instead of searching; the others
            begin in the middle of their priors.
        seed: Seed of the search.
        progress: Called with the fraction done and a short status.

    Raises:
        DataError: No parameters could be simulated along the recording.
    """
    segments = SegmentModel(model, rollouts, options)
    # Wrong units are told apart here: the search would only find that nothing fits.
    simulator = segments.simulator
    rollouts.check(simulator.sensors, simulator.actions, allow_extra=True)
    starts = torch.zeros(segments.inputs.num_segments, segments.num_offsets, dtype=torch.float64)
    z = segments.place_of(near) if near else _searched(segments, starts, seed, progress)
    if segments.num_offsets:
        return ClosestFit(segments, fit_segments(segments, z))
    return ClosestFit(segments, SegmentFit(z, starts, segments.scale_of(z, starts)))


def _searched(segments: SegmentModel, starts: Tensor, seed: int, progress: Step | None) -> Tensor:
    """Returns the best place that a cross-entropy search finds, ``(d,)``; see `closest_fit`."""
    mask = segments.inputs.mask[..., None]
    ranges = (segments.observed * mask).abs().amax((0, 1)).double()
    ranges = ranges.clamp_min(torch.finfo(torch.float32).tiny)
    num_parameters = segments.prior.num_parameters
    centre = torch.zeros(num_parameters, dtype=torch.float64)
    spread = torch.ones_like(centre)
    least, z = math.inf, centre
    for iteration in range(ITERATIONS):
        with seeded(seed, "residual noise", iteration):
            if iteration == 0:
                tried = segments.prior.sample(POPULATION)
            else:
                draws = torch.randn(POPULATION, num_parameters, dtype=torch.float64)
                tried = centre + spread * draws
        residual = segments.residuals(tried, starts.expand(POPULATION, -1, -1), ranges)
        square = residual.square().unflatten(-1, (-1, len(ranges))).sum((1, 2)) / mask.sum()
        error = square.sqrt().mean(-1).nan_to_num(math.inf)
        elite = error.argsort()[: POPULATION // 10]
        centre, spread = tried[elite].mean(0), tried[elite].std(0)
        if float(error[elite[0]]) < least:
            least, z = float(error[elite[0]]), tried[elite[0]]
        if progress is not None:
            progress((iteration + 1) / ITERATIONS, f"error {least:.3g} of the range")
    if not math.isfinite(least):
        raise DataError(
            "No parameters of the prior could be simulated along the recording; check its units "
            "(radians, metres, seconds), the signs of its columns, and the prior."
        )
    return z


def score_embedding(found: ClosestFit) -> Score:
    """Returns the embedding that compresses trajectories into their score at the closest fit.

    Initial states are integrated out.
    """
    segments, fit = found.segments, found.fit
    now = found.linearisation
    # A parameter that does nothing has a score of zero.
    deviation = now.information().diagonal().sqrt().clamp_min(1e-12)
    weights = now.weights().unflatten(1, segments.observed.shape[1:]) / fit.scale[:, None]
    mean = segments.simulate(fit.z[None], fit.offsets[None])[0]
    return Score(mean, weights, deviation)
