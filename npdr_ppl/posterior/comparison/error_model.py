"""The error model that posteriors of several backends are compared under.

A segment's log likelihood depends on how large the measurements' errors are and on how many of
them are independent. Were either estimated from each posterior's own residuals, a posterior that
misses the recording would earn itself a wide error and few independent measurements, and its elpd
would not be comparable. Both are therefore found once, by the common preparation of the recording
that is fitted, before any backend has seen it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.posterior.prepare import Preparation, prepare
from npdr_ppl.preparation.binding import BoundModel, Data
from npdr_ppl.preparation.closest_fit import ClosestFit, closest_fit
from npdr_ppl.preparation.data_options import MAX_READINGS_PER_CHUNK, DataOptions
from npdr_ppl.preparation.effective_share import effective_share
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.progress import Step
from npdr_ppl.rollouts import Rollouts

__all__ = ["ErrorModel", "find_error_model", "segment_log_likelihood"]


@dataclass(frozen=True)
class ErrorModel:
    """The measurement errors that all backends of a comparison assume.

    Attributes:
        prepared: The preparation of the recording; ``None`` for observations of plain functions
            and for several sites, which keep the model's own noise.
        fitted: The model that the backends receive.
        judged: The model whose noise is used for likelihoods. It differs from ``fitted`` only if
            the backends fit a model without noise.
        noise: Estimated standard deviation by channel, in its unit; ``None`` if the model declares
            its own.
        share: Share of independent measurements by channel; if empty, all count as independent.
    """

    prepared: Preparation | None
    fitted: Callable[..., Any]
    judged: Callable[..., Any]
    noise: Mapping[str, float] | None
    share: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return {
            "scale": "declared by the model" if self.noise is None else dict(self.noise),
            "independent_share": dict(self.share),
        }


def find_error_model(
    model: Model,
    train: Data,
    options: DataOptions,
    *,
    seed: int = 0,
    progress: Step | None = None,
) -> ErrorModel:
    """Finds the common error model on the recording to be fitted.

    Args:
        model: The Pyro model.
        train: The recording to be fitted, not the held-out one. For observations of a plain
            function or of several sites, the model's own noise is used, and all measurements count
            as independent.
        options: How the data are prepared. If they keep a model without noise, the scale is
            estimated only for the comparison.
        seed: Seed of the search.
        progress: Called with the fraction done and a short status.

    Raises:
        DataError: No parameters could be simulated along the recording.
    """
    if not isinstance(train, Rollouts):
        return ErrorModel(None, model, model, None, {})
    found = prepare(model, train, replace(options, noise="auto"), seed=seed, progress=progress)
    plain = prepare_as_it_is(found, options.noise)
    if found.likelihood is not None:
        names = found.likelihood.segments.channel_names
        share = dict.fromkeys(names, found.likelihood.share)
    else:
        closest = found.closest or closest_fit(model, train, options, seed=seed)
        share = _share_of_residuals(model, train, options, closest)
    return ErrorModel(plain, plain.model, found.model, found.noise, share)


def prepare_as_it_is(found: Preparation, noise: Literal["auto", "model"]) -> Preparation:
    """Returns a preparation whose model keeps its own noise if ``noise`` is ``"model"``."""
    if noise == "auto" or found.noise is None:
        return found
    return replace(found, model=found.plain_model, noise=None, noise_of_sensors=None)


def _share_of_residuals(
    model: Model, train: Rollouts, options: DataOptions, closest: ClosestFit
) -> dict[str, float]:
    """Returns the share of independent measurements if initial states are taken as exact."""
    replayed = replay(model, train, closest.parameters, options)
    observed = train.observation(replayed.inputs, channels=replayed.channel_names)
    residual = (replayed.trajectory[0] - observed).double().cpu()
    measured = replayed.inputs.measured(replayed.channel_names).cpu()
    share = effective_share(residual, measured)
    return dict(zip(replayed.channel_names, share.tolist(), strict=True))


def segment_log_likelihood(bound: BoundModel, z: Tensor, share: Mapping[str, float]) -> Tensor:
    """Returns log p(segment | draw), ``(n, segments)`` float64; minus infinity for failed draws.

    An observation of a plain function, which has no segments, counts as one.

    Args:
        bound: The model with its noise, and the recording on which it is evaluated.
        z: Draws in reference coordinates, ``(n, d)``.
        share: Share of independent measurements by channel; if empty, all count as independent.

    Raises:
        IntractableError: The model declares no noise, so there is no density.
    """
    if bound.likelihood is not None:
        return bound.likelihood.by_segment(z)
    readings = sum(o.value.numel() for o in bound.observations.values())
    chunk = max(1, MAX_READINGS_PER_CHUNK // max(1, readings))
    parts = [
        torch.cat([_of_site(bound, name, part, share) for name in bound.observations], dim=1)
        for part in z.split(chunk)
    ]
    result = torch.cat(parts)
    return result.where(result.isfinite(), -torch.inf)


def _of_site(bound: BoundModel, name: str, z: Tensor, share: Mapping[str, float]) -> Tensor:
    observation, prior = bound.observations[name], bound.prior
    density = _density(prior, name, observation.value, z)
    if observation.inputs is None or observation.channels is None:
        return density.reshape(len(z), -1).sum(-1, keepdim=True)
    channels = list(observation.channels)
    mask = observation.inputs.measured(observation.inputs.channel_names).cpu()
    # Steps after a segment's end are made up and may be anything, infinite included.
    density = density[..., channels].where(mask, 0.0)
    weights = torch.tensor(
        [share.get(_channel(prior, name, c), 1.0) for c in channels], dtype=torch.float64
    )
    return (density * weights).sum((-1, -2)).flatten(1)


def _density(prior: Prior, name: str, value: Tensor, z: Tensor) -> Tensor:
    return prior.pointwise_log_prob(name, value, z).double().cpu()


def _channel(prior: Prior, name: str, index: int) -> str:
    box: Any = prior.black_boxes[name]
    return box.simulator.sensors[index].name
