"""How well a posterior predicts recorded segments: elpd, CRPS and coverage."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.errors import IntractableError
from npdr_ppl.posterior.comparison.error_model import segment_log_likelihood
from npdr_ppl.posterior.posterior import PosteriorBase
from npdr_ppl.preparation.binding import BoundModel, Observation
from npdr_ppl.preparation.draw_budget import affordable_draws, executed_in_parts
from npdr_ppl.randomness import seeded

__all__ = ["LEVELS", "PredictiveScores", "loo_elpd", "predictive_elpd", "predictive_scores"]

LEVELS = (0.5, 0.8, 0.95)
"""Nominal probabilities of the predictive intervals."""

NUM_LIKELIHOOD_DRAWS = 1_000
"""Number of posterior draws over which a segment's predictive density is averaged."""

NUM_PREDICTIVE_DRAWS = 200
"""Number of posterior predictive trajectories from which CRPS and coverage are computed; fewer if
they do not fit in memory, see :mod:`npdr_ppl.preparation.draw_budget`."""


@dataclass(frozen=True)
class PredictiveScores:
    """Scores of a posterior on a recording.

    Attributes:
        elpd: Log predictive density of every segment, ``(segments,)``, with the common error
            model; ``None`` if there is no likelihood.
        elpd_draws: Effective number of draws in a segment's density, for the segment where it is
            smallest. Near 1, a single draw determines that density. NaN without elpd.
        crps: Mean CRPS of a measurement in units of its channel's range; NaN if no draw could be
            simulated.
        coverage: Share of measurements inside the central predictive interval, by its probability.
        num_failed: Predictive draws that could not be simulated, and were left out.
    """

    elpd: NDArray[np.float64] | None
    elpd_draws: float
    crps: float
    coverage: dict[float, float]
    num_failed: int


def predictive_scores(
    posterior: PosteriorBase,
    bound: BoundModel,
    share: Mapping[str, float],
    *,
    is_held_out: bool,
    seed: int = 0,
) -> PredictiveScores:
    """Scores a posterior's predictions.

    Args:
        posterior: The posterior.
        bound: The model with its noise, and the recording on which it is evaluated.
        share: Share of independent measurements by channel; see
            :mod:`npdr_ppl.posterior.comparison.error_model`.
        is_held_out: Whether the recording was not used for the posterior; if it was used, elpd is
            computed by leave-one-out over segments.
        seed: Seed of the draws.
    """
    z = posterior.sample_mixture(NUM_LIKELIHOOD_DRAWS, seed=seed)
    try:
        likelihood = segment_log_likelihood(bound, z, share)
    except IntractableError:
        elpd, draws = None, float("nan")
    else:
        elpd = predictive_elpd(likelihood) if is_held_out else loo_elpd(likelihood)
        draws = _effective_draws(likelihood)
    num_readings = sum(o.value.numel() for o in bound.observations.values())
    num_draws = affordable_draws(NUM_PREDICTIVE_DRAWS, num_readings)
    with seeded(seed, "predictive scores"):
        parts = list(executed_in_parts(bound.prior, z[:num_draws], num_readings))
    predictive = {name: [outputs[name] for _, outputs in parts] for name in parts[0][1]}
    crps, coverage, failed = _of_readings(bound, predictive)
    return PredictiveScores(elpd, draws, crps, coverage, failed)


def predictive_elpd(log_likelihood: Tensor) -> NDArray[np.float64]:
    """Returns log p(y_i) = log 1/n Σ_j p(y_i | ξ_j) of segments the draws know nothing of.

    Args:
        log_likelihood: log p(y_i | ξ_j), ``(n, segments)``; minus infinity for failed draws.

    Returns:
        ``(segments,)``; minus infinity where no draw allows the segment.
    """
    mean = log_likelihood.logsumexp(0) - np.log(len(log_likelihood))
    return mean.numpy()


def loo_elpd(log_likelihood: Tensor) -> NDArray[np.float64]:
    """Returns log p(y_i | other segments) by Pareto-smoothed importance sampling.

    Vehtari, Gelman & Gabry (2017), https://arxiv.org/abs/1507.04544. For draws of a posterior that
    was fitted to these segments; it presumes that the posterior is exact.

    Args:
        log_likelihood: log p(y_i | ξ_j), ``(n, segments)``; minus infinity for failed draws.
    """
    from npdr_ppl.arviz_module import from_dict, loo

    # Failed draws have no likelihood to weigh by; those left are draws of the posterior still.
    whole = log_likelihood[log_likelihood.isfinite().all(1)]
    if not len(whole):
        return np.full(log_likelihood.shape[1], -np.inf)
    data = from_dict(
        {
            "posterior": {"draw_number": np.arange(len(whole))[None]},
            "log_likelihood": {"y": whole[None].numpy()},
        }
    )
    with warnings.catch_warnings():
        # Of large Pareto k, and of a single segment.
        warnings.simplefilter("ignore")
        return loo(data).elpd_i.reshape(-1)


def _effective_draws(log_likelihood: Tensor) -> float:
    """Returns the least (Σ_j p_ij)² / Σ_j p_ij² of any segment i, 0 where no draw allows it."""
    log_sum = log_likelihood.logsumexp(0)
    ratio = (2 * log_sum - (2 * log_likelihood).logsumexp(0)).exp()
    return float(ratio.where(log_sum.isfinite(), 0.0).min())


def _of_readings(
    bound: BoundModel, predictive: Mapping[str, Sequence[Tensor]]
) -> tuple[float, dict[float, float], int]:
    """Returns mean scaled CRPS, coverage by level, and how many draws failed.

    Args:
        bound: The model, and the recording on which it is evaluated.
        predictive: Simulations ``(n,) + plates + event`` by site, in parts.
    """
    valid = torch.stack(
        [
            torch.cat([part.reshape(len(part), -1).isfinite().all(1).cpu() for part in parts])
            for parts in predictive.values()
        ]
    ).all(0)
    num_failed = int((~valid).sum())
    if not bool(valid.any()):
        return float("nan"), dict.fromkeys(LEVELS, float("nan")), num_failed
    scores, ranks = [], []
    for name, observation in bound.observations.items():
        for column, observed, counted in _columns(observation):
            samples = torch.cat(
                [_column(part, column).double().cpu() for part in predictive[name]]
            )
            samples = samples[valid]
            largest = (observed * counted).abs().amax()
            scale = torch.where(largest > 0, largest, 1.0)
            scores.append((metrics.crps(samples, observed) / scale)[counted])
            ranks.append(metrics.pit(samples, observed)[counted])
    coverage = metrics.coverage(torch.cat(ranks), LEVELS)
    return (
        float(torch.cat(scores).mean()),
        dict(zip(LEVELS, coverage.tolist(), strict=True)),
        num_failed,
    )


def _columns(observation: Observation) -> Iterator[tuple[int | None, Tensor, Tensor]]:
    """Yields each measured channel's position, its measurements, and a mask of those that count.

    Channels are processed one by one, because the scores of an ensemble copy it several times. A
    plain function's output is one channel.
    """
    observed = observation.value.double().cpu()
    if observation.inputs is None or observation.channels is None:
        yield None, observed.reshape(-1), torch.ones(observed.numel(), dtype=torch.bool)
        return
    names = observation.inputs.channel_names
    measured = observation.inputs.measured(names).cpu()
    measured = measured.expand(*measured.shape[:-1], len(names))
    for column, taken in zip(observation.channels, measured.unbind(-1), strict=True):
        readings = observed[..., column]
        yield column, readings, taken.expand(readings.shape)


def _column(output: Tensor, column: int | None) -> Tensor:
    """Returns one channel of simulations, or all of a plain function's output in a row."""
    return output.reshape(len(output), -1) if column is None else output[..., column]
