"""The proof: distance to held-out recordings before and after the model was revised."""

from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.parameter_intervals import Draws
from npdr_ppl.discovery.proof.settings import GAP
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.initial_states import error_factors
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts, stitch

__all__ = ["Gap", "prove"]


@dataclass(frozen=True)
class Gap:
    """A metric on held-out rollouts.

    Attributes:
        before: Its value for the original model, refitted.
        after: Its value for the revised model.
        noise_floor: Its value if the revised model itself made the recording, because
            measurements and initial states have errors; ``None`` for a metric that has no floor.
            Another model may have a slightly smaller value by chance.
    """

    before: float
    after: float
    noise_floor: float | None

    @property
    def closed(self) -> float | None:
        """Share of the gap above the noise floor that was closed; ``None`` without such a gap."""
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
    options: DataOptions,
    *,
    draws_before: Draws,
    draws_after: Draws,
    seed: int,
) -> dict[str, Gap]:
    """Compares two fitted models on rollouts that neither was fitted to.

    Args:
        before: The original model.
        after: The revised model.
        rollouts: The held-out recording, of another excitation if there is one.
        options: How it is cut into segments.
        draws_before: Draws of the posterior of the original model.
        draws_after: Draws of the posterior of the revised model.
        seed: Seed of the predictive draws.
    """
    with seeded(seed, "discovery", "proof"):
        drawn = draws_after.resampled(GAP.num_draws)
        old = _Scores.of(before, draws_before.resampled(GAP.num_draws), rollouts, options)
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
        cls, hypothesis: Hypothesis, drawn: Tensor, rollouts: Rollouts, options: DataOptions
    ) -> "_Scores":
        segments = SegmentModel(hypothesis.model, rollouts, options, is_complete=True)
        z = hypothesis.fit.z[None]
        centre = segments.simulate(z, _no_offsets(segments, 1))[0].double()
        part = segments.along(options.used_segments(rollouts))
        draws = _predictive(hypothesis, drawn, part)
        return cls(
            *_distances(segments, centre, rollouts),
            _crps(part, draws, part.observed.double()),
            _coverage(part, draws),
        )


def _floor(
    hypothesis: Hypothesis, drawn: Tensor, rollouts: Rollouts, options: DataOptions
) -> dict[str, float]:
    """Returns the metrics of a recording that is simulated with the model itself.

    Its initial states have errors as large as along the real recording, and its measurements have
    noise. It is compared with the prediction from the smoother's estimate.
    """
    segments = SegmentModel(hypothesis.model, rollouts, options, is_complete=True)
    z, unmoved = hypothesis.fit.z[None], _no_offsets(segments, 1)
    centre = segments.simulate(z, unmoved)[0].double()
    offsets = torch.randn(unmoved.shape).double()
    used = options.used_segments(rollouts)
    part = segments.along(used)
    now = part.linearise(z[0], unmoved[0, used], hypothesis.fit.scale, is_rough=True)
    if now.is_finite:
        offsets = offsets * error_factors(now.residual, now.by_starts)
    made = segments.simulate(z, offsets)[0].double()
    made = (
        made + reading_noise(rollouts, segments.channel_names) * torch.randn(made.shape).double()
    )
    channels = segments.channel_names
    predicted = stitch(centre, segments.inputs, channels)
    recorded = stitch(made, segments.inputs, channels)
    draws = _predictive(hypothesis, drawn, part)
    return {
        "rmse": float(metrics.rmse(predicted, recorded).mean()),
        "dtw": float(metrics.dtw(predicted, recorded).mean()),
        "crps": _crps(part, draws, made[used]),
    }


def reading_noise(rollouts: Rollouts, channels: tuple[str, ...]) -> Tensor:
    """Returns the standard deviation of the measurements' noise, ``(C,)``.

    It is computed from third differences, in which any smooth motion is negligible.
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


def _predictive(hypothesis: Hypothesis, drawn: Tensor, segments: SegmentModel) -> Tensor:
    """Returns posterior predictive trajectories, measurement noise included."""
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
    return float(metrics.coverage(values, [GAP.level], segments.inputs.mask)[0])
