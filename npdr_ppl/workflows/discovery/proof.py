"""The proof: how far the model was from recordings that were held out, and how far it is now."""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.randomness import derived_seed, seeded
from npdr_ppl.rollouts import Rollouts, stitch
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.discovery.credible import posterior_draws
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis
from npdr_ppl.workflows.segment_model import SegmentModel

__all__ = ["Gap", "prove"]

NUM_DRAWS = 40
"""Posterior predictive trajectories."""

NUM_PROPOSALS = 64
"""Draws of the posterior that they are taken from, each a simulation of the fitted recording."""

LEVEL = 0.9
"""Probability of the predictive interval whose coverage is reported."""


@dataclass(frozen=True)
class Gap:
    """A metric on held-out rollouts.

    Attributes:
        before: With the model as it was, refitted.
        after: With the revised model.
        noise_floor: What a model without error would have, because readings and initial states
            have errors; ``None`` for a metric that has no floor.
    """

    before: float
    after: float
    noise_floor: float | None

    @property
    def closed(self) -> float | None:
        """Share of what could be closed that was closed; ``None`` where nothing could be."""
        if self.noise_floor is None or self.before <= self.noise_floor:
            return None
        return (self.before - self.after) / (self.before - self.noise_floor)

    def to_dict(self) -> dict[str, float | None]:
        """Returns JSON-serialisable values."""
        return {
            "before": self.before,
            "after": self.after,
            "noise_floor": self.noise_floor,
            "closed": self.closed,
        }


def prove(
    before: Hypothesis,
    after: Hypothesis,
    rollouts: Rollouts,
    options: BindingOptions,
    *,
    seed: int,
) -> dict[str, Gap]:
    """Compares two fitted models on rollouts that neither was fitted to.

    Args:
        before: The model as it was.
        after: The revised model.
        rollouts: The held-out recording, of another excitation where there is one.
        options: Its segments.
        seed: Seed of the predictive draws.
    """
    with seeded(seed, "discovery", "proof"):
        drawn = _draws(after, seed)
        old = _Scores.of(before, _draws(before, seed), rollouts, options)
        new = _Scores.of(after, drawn, rollouts, options)
        floor = _floor(after, drawn, rollouts, options)
    return {
        "rmse": Gap(old.rmse, new.rmse, floor["rmse"]),
        "dtw": Gap(old.dtw, new.dtw, floor["dtw"]),
        "crps": Gap(old.crps, new.crps, floor["crps"]),
        "coverage": Gap(old.coverage, new.coverage, None),
    }


@dataclass(frozen=True)
class _Scores:
    rmse: float
    dtw: float
    crps: float
    coverage: float

    @classmethod
    def of(
        cls, hypothesis: Hypothesis, drawn: Tensor, rollouts: Rollouts, options: BindingOptions
    ) -> "_Scores":
        segments = SegmentModel(hypothesis.model, rollouts, options)
        z = hypothesis.fit.z[None]
        centre = segments.simulate(z, _no_offsets(segments, 1))[0].double()
        draws = _predictive(hypothesis, drawn, segments)
        return cls(
            *_distances(segments, centre, rollouts),
            _crps(segments, draws, segments.observed.double()),
            _coverage(segments, draws),
        )


def _floor(
    hypothesis: Hypothesis, drawn: Tensor, rollouts: Rollouts, options: BindingOptions
) -> dict[str, float]:
    """Returns the metrics of a recording that the model itself might have made.

    From initial states off by the smoother's errors, with readings off by their noise, scored
    against the prediction from the smoother's estimate.
    """
    segments = SegmentModel(hypothesis.model, rollouts, options)
    z = hypothesis.fit.z[None]
    centre = segments.simulate(z, _no_offsets(segments, 1))[0].double()
    made = segments.simulate(z, torch.randn(_no_offsets(segments, 1).shape).double())[0].double()
    made = (
        made + reading_noise(rollouts, segments.channel_names) * torch.randn(made.shape).double()
    )
    channels = segments.channel_names
    predicted = stitch(centre, segments.inputs, channels)
    recorded = stitch(made, segments.inputs, channels)
    draws = _predictive(hypothesis, drawn, segments)
    return {
        "rmse": float(metrics.rmse(predicted, recorded).mean()),
        "dtw": float(metrics.dtw(predicted, recorded).mean()),
        "crps": _crps(segments, draws, made),
    }


def reading_noise(rollouts: Rollouts, channels: tuple[str, ...]) -> Tensor:
    """Returns the standard deviation of the readings' own errors, ``(C,)``.

    From third differences, where any smooth motion is negligible.
    """
    columns = [rollouts.channel_names.index(name) for name in channels]
    parts = []
    for readings in rollouts.readings:
        third = torch.as_tensor(readings[:, columns]).diff(n=3, dim=0).double()
        parts.append(third.abs().median(0).values / 0.6745 / 20**0.5)
    return torch.stack(parts).median(0).values


def _no_offsets(segments: SegmentModel, num: int) -> Tensor:
    shape = num, segments.inputs.num_segments, segments.num_offsets
    return torch.zeros(shape, dtype=torch.float64)


def _draws(hypothesis: Hypothesis, seed: int) -> Tensor:
    """Returns parameters of the posterior, ``(NUM_DRAWS, d)``."""
    own_seed = derived_seed(seed, "discovery", "proof")
    return posterior_draws(hypothesis, seed=own_seed, num=NUM_PROPOSALS).resampled(NUM_DRAWS)


def _predictive(hypothesis: Hypothesis, drawn: Tensor, segments: SegmentModel) -> Tensor:
    """Returns posterior predictive trajectories, readings' noise included."""
    offsets = torch.randn(_no_offsets(segments, len(drawn)).shape, dtype=torch.float64)
    trajectory = segments.simulate(drawn, offsets).double()
    return trajectory + hypothesis.fit.scale * torch.randn(trajectory.shape, dtype=torch.float64)


def _distances(segments: SegmentModel, centre: Tensor, rollouts: Rollouts) -> tuple[float, float]:
    channels = segments.channel_names
    simulated = stitch(centre, segments.inputs, channels)
    measured = rollouts.series(channels)
    return (
        float(metrics.rmse(simulated, measured).mean()),
        float(metrics.dtw(simulated, measured).mean()),
    )


def _crps(segments: SegmentModel, draws: Tensor, observed: Tensor) -> float:
    ranges = (observed * segments.inputs.mask[..., None]).abs().amax((0, 1)).clamp_min(1e-12)
    by_step = metrics.crps_by_step(draws, observed, segments.inputs.mask, is_fair=True)
    return float((by_step / ranges).mean())


def _coverage(segments: SegmentModel, draws: Tensor) -> float:
    values = metrics.pit(draws, segments.observed.double())
    return float(metrics.coverage(values, [LEVEL], segments.inputs.mask)[0])
