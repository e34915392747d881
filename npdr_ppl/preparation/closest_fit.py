"""The closest fit of a model to a recording, and the noise that it implies.

A simulator that lacks an effect never reproduces a recording exactly. Without noise of the size of
the remaining residuals, the recording differs from every simulation, and a likelihood-free
posterior extrapolates. The closest fit gives the size of that noise. It is also the point around
which trajectories are compressed into their score.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.language.model import Model
from npdr_ppl.preparation.data_options import DataOptions, one_of_each_part
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.preparation.settings import PRIOR_SEARCH
from npdr_ppl.progress import Step
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts

__all__ = ["ClosestFit", "closest_fit", "part_of", "search_prior"]


@dataclass(frozen=True)
class ClosestFit:
    """The closest fit of a model to a recording, if initial states are taken as true.

    Attributes:
        parameters: Those with the smallest residual, ``(1,) + site.shape`` by latent site.
        scale: Root-mean-square residual by measured channel, in the channel's unit.
        noise: The same for all sensors; negligible for those that were not measured.
    """

    parameters: dict[str, Tensor]
    scale: dict[str, float]
    noise: dict[str, float]


def closest_fit(
    model: Model,
    rollouts: Rollouts,
    options: DataOptions,
    *,
    seed: int = 0,
    progress: Step | None = None,
) -> ClosestFit:
    """Searches for the parameters of least residual along a recording; see :func:`search_prior`.

    Residuals that errors of the initial states cause count as noise.

    Args:
        model: The Pyro model.
        rollouts: The recording to be fitted; never the held-out one.
        options: Segments, initial states and precision.
        seed: Seed of the search.
        progress: Called with the fraction done and a short status.

    Raises:
        DataError: No parameters could be simulated along the recording.
    """
    segments = SegmentModel(model, rollouts, options)
    z = search_prior(segments, seed=seed, progress=progress)
    found = segments.scale_of(z, segments.no_offsets).tolist()
    scale = dict(zip(segments.channel_names, found, strict=True))
    noise = {
        name: scale.get(name, PRIOR_SEARCH.negligible_deviation) for name in segments.sensor_names
    }
    return ClosestFit(segments.prior.to_parameters(z[None]), scale, noise)


def search_prior(
    segments: SegmentModel,
    *,
    iterations: int = PRIOR_SEARCH.iterations,
    seed: int = 0,
    progress: Step | None = None,
) -> Tensor:
    """Returns the best point of a cross-entropy search, in reference coordinates ``(d,)``.

    The search (Rubinstein 1999) is short and simulates segments from the whole recording. It
    finds the basin of the closest fit, not its lowest point.

    Args:
        segments: The model along the recording.
        iterations: Iterations, of ``PRIOR_SEARCH.population`` simulations each.
        seed: Seed of the search.
        progress: Called with the fraction done and a short status.

    Raises:
        DataError: No parameters could be simulated along the recording.
    """
    every = segments
    ranges = (every.observed * every.is_measured).abs().amax((0, 1)).double()
    ranges = ranges.clamp_min(torch.finfo(torch.float32).tiny)
    segments = every.along(part_of(every, seed=seed))
    num_parameters = segments.prior.num_parameters
    centre = torch.zeros(num_parameters, dtype=torch.float64)
    spread = torch.ones_like(centre)
    least, z, elite = math.inf, centre, centre[None]
    if progress is not None:
        progress(0.0, "")
    for iteration in range(iterations):
        with seeded(seed, "residual noise", iteration):
            if iteration == 0:
                tried = segments.prior.sample(PRIOR_SEARCH.population)
            else:
                draws = torch.randn(PRIOR_SEARCH.population, num_parameters, dtype=torch.float64)
                tried = centre + spread * draws
        error = torch.cat(
            [
                _errors(segments, part, segments.no_offsets, ranges)
                for part in tried.split(segments.draws_per_chunk)
            ]
        )
        order = error.argsort()
        elite = tried[order[: PRIOR_SEARCH.population // 10]]
        centre, spread = elite.mean(0), elite.std(0)
        if float(error[order[0]]) < least:
            least, z = float(error[order[0]]), tried[order[0]]
        if progress is not None:
            progress((iteration + 1) / iterations, f"error {least:.3g} of the range")
    if segments.inputs.num_segments < every.inputs.num_segments:
        # Parameters that can be simulated along some segments may fail along others.
        for place in (z, *elite):
            z, least = place, float(_errors(every, place[None], every.no_offsets, ranges))
            if math.isfinite(least):
                break
    if not math.isfinite(least):
        raise DataError(
            "No parameters of the prior could be simulated along the recording; check its units "
            "(radians, metres, seconds), the signs of its columns, and the prior."
        )
    return z


def part_of(
    segments: SegmentModel, num: int = PRIOR_SEARCH.most_segments, *, seed: int = 0
) -> Tensor:
    """Returns the indices of a segment of each of equal parts of the recording.

    Args:
        segments: The model along the recording.
        num: Number of parts; by default enough to begin a fit with.
        seed: Seed of the choice.
    """
    most = segments.inputs.num_segments
    return one_of_each_part(min(num, most), most, seed=seed)


def _errors(segments: SegmentModel, z: Tensor, starts: Tensor, ranges: Tensor) -> Tensor:
    """Returns the distance of simulations at points ``(n, d)`` from the recording, ``(n,)``.

    It is the mean, over channels, of the root-mean-square error relative to the channel's range.
    """
    residual = segments.residuals(z, starts.expand(len(z), -1, -1), ranges)
    square = residual.square().unflatten(-1, (-1, len(ranges))).sum((1, 2))
    count = segments.num_measured.sum(0).clamp_min(1)
    return (square / count).sqrt().mean(-1).nan_to_num(math.inf)
