"""The proof: distance to held-out recordings before and after the model was revised."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from npdr_ppl import metrics
from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.estimated_anew import EstimatedAnew
from npdr_ppl.discovery.proof.parameter_intervals import Draws
from npdr_ppl.discovery.proof.settings import GAP
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.initial_states import error_draws, error_factors
from npdr_ppl.preparation.linearisation import Linearisation
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts, stitch
from npdr_ppl.rollouts.states import measurement_noise

__all__ = ["Gap", "prove"]


@dataclass(frozen=True)
class Gap:
    """A metric on held-out rollouts.

    Attributes:
        before: Its value for the original model, refitted.
        after: Its value for the revised model.
        noise_floor: Its value for a recording that the revised model made. It is not zero, because
            measurements and estimated initial states have errors. A model may be below it by
            chance; the true model is at most a fifth above it. ``None`` for a metric that has no
            floor.
    """

    before: float
    after: float
    noise_floor: float | None

    @property
    def closed(self) -> float | None:
        """Share of the gap above the noise floor that was closed; ``None`` without such a gap.

        There is none if the original model is as close to the floor as a true model may be.
        """
        if self.noise_floor is None or self.before <= GAP.excess * self.noise_floor:
            return None
        return (self.before - self.after) / (self.before - self.noise_floor)

    @property
    def has_grown(self) -> bool:
        """Whether the revised model's error is clearly larger, or not a number."""
        return not self.after <= GAP.excess * self.before

    @property
    def is_open(self) -> bool:
        """Whether most of the gap is left above the noise floor, or the error has grown."""
        if self.noise_floor is None:
            return False
        left, whole = self.after - self.noise_floor, self.before - self.noise_floor
        is_above = self.after > GAP.excess * self.noise_floor
        return self.has_grown or (is_above and left > (1.0 - GAP.mostly_closed) * whole)

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
    anew: EstimatedAnew | None = None,
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
        anew: Parameters of the revised model that were estimated anew on the held-out recording.
    """
    with seeded(seed, "discovery", "proof"):
        drawn = draws_after.resampled(GAP.num_draws)
        old = _Simulated(before, draws_before.resampled(GAP.num_draws), rollouts, options).scores()
        revised = _Simulated(after, drawn, rollouts, options, anew)
        new, floor = revised.scores(), revised.floor()
    return {
        "rmse": Gap(old.rmse, new.rmse, floor.rmse),
        "dtw": Gap(old.dtw, new.dtw, floor.dtw),
        "crps": Gap(old.crps, new.crps, floor.crps),
        "coverage": Gap(old.coverage, new.coverage, None),
    }


@dataclass(frozen=True)
class _Scores:
    rmse: float
    dtw: float
    crps: float
    coverage: float


class _Simulated:
    """A fitted model along held-out rollouts.

    Args:
        hypothesis: The model.
        drawn: Draws of its posterior, ``(n, d)``.
        rollouts: The recording.
        options: How it is cut into segments.
        anew: Parameters that were estimated anew on this recording.
    """

    def __init__(
        self,
        hypothesis: Hypothesis,
        drawn: Tensor,
        rollouts: Rollouts,
        options: DataOptions,
        anew: EstimatedAnew | None = None,
    ) -> None:
        segments = SegmentModel(hypothesis.model, rollouts, options, is_complete=True)
        self.fit, self.drawn, self.segments = hypothesis.fit, drawn, segments
        self.recorded = rollouts.series(segments.channel_names)
        self.used = options.used_segments(rollouts)
        # Draws are compared along these segments only, to bound memory.
        self.part = segments.along(self.used)
        self.anew = anew
        self._every = torch.arange(segments.inputs.num_segments)
        self.centre = self._simulate(segments, self.fit.z[None], segments.no_offsets[None])[0]

    def scores(self) -> _Scores:
        """Returns the metrics of the recording."""
        return self._scores(self.recorded, self.part.observed.double())

    def floor(self) -> _Scores:
        """Returns the metrics of a recording that is simulated with the model itself.

        Its initial states differ from the estimates as those of the real recording do, and its
        measurements have noise. It is compared with the prediction from the estimates.
        """
        segments = self.segments
        offsets = self._true_starts()
        made = self._simulate(segments, self.fit.z[None], offsets[None])[0]
        made = made + measurement_noise(self.recorded) * torch.randn(made.shape).double()
        recorded = stitch(made, segments.inputs, segments.channel_names)
        return self._scores(recorded, made[self.used])

    def _true_starts(self) -> Tensor:
        """Returns offsets from the estimates to initial states that may be the true ones."""
        now = self._along_part
        factors = torch.ones(self.segments.num_offsets, dtype=torch.float64)
        if now.is_finite:
            factors = error_factors(now.residual, now.by_starts)
        offsets = []
        # As many segments at once as are used elsewhere, to bound memory.
        for index in self._every.split(len(self.used)):
            if len(index) < len(self._every):
                now = self._linearised(self.segments.along(index), index)
            offsets.append(error_draws(now.residual, now.by_starts, factors))
        return torch.cat(offsets)

    @cached_property
    def _along_part(self) -> Linearisation:
        return self._linearised(self.part, self.used)

    def _start_factors(self) -> Tensor:
        """Returns by how much the initial states' errors are larger than assumed, ``(S, m)``.

        Every second segment gets the factors of the others, so that no segment's own measurements
        make its band wider.
        """
        now = self._along_part
        factors = torch.ones(self.part.no_offsets.shape, dtype=torch.float64)
        if now.is_finite:
            for own, others in ((0, 1), (1, 0)):
                residual, by_starts = now.residual[others::2], now.by_starts[others::2]
                if len(residual):
                    factors[own::2] = error_factors(residual, by_starts)
        return factors

    def _linearised(self, segments: SegmentModel, index: Tensor) -> Linearisation:
        """Returns derivatives along some of the segments, which have these indices."""
        if self.anew is not None:
            return self.anew.linearise(segments, self.fit, segments.no_offsets, self._late(index))
        return segments.linearise(self.fit.z, segments.no_offsets, self.fit.scale, is_rough=True)

    def _simulate(
        self, segments: SegmentModel, z: Tensor, offsets: Tensor, index: Tensor | None = None
    ) -> Tensor:
        """Returns simulated measurements along segments; ``index`` as in :meth:`_linearised`."""
        if self.anew is None:
            return segments.simulate(z, offsets).double()
        late = self._late(self._every if index is None else index)
        return self.anew.simulate(segments, z, offsets, late).double()

    def _late(self, index: Tensor) -> Tensor:
        """Returns whether segments come after the middle of those that draws are made along."""
        return index >= self.used[(len(self.used) + 1) // 2]

    def _scores(self, recorded: list[Tensor], observed: Tensor) -> _Scores:
        """Returns the metrics of rollouts, and of their segments that draws are made along."""
        predicted = stitch(self.centre, self.segments.inputs, self.segments.channel_names)
        draws, mask = self._predictive(), self.part.inputs.mask
        return _Scores(
            float(metrics.rmse(predicted, recorded).mean()),
            float(metrics.dtw(predicted, recorded).mean()),
            _crps(draws, observed, mask),
            float(metrics.coverage(metrics.pit(draws, observed), [GAP.level], mask)[0]),
        )

    def _predictive(self) -> Tensor:
        """Returns posterior predictive trajectories.

        They include the errors of the estimated initial states, and measurement noise.
        """
        shape = len(self.drawn), *self.part.no_offsets.shape
        offsets = self._start_factors() * torch.randn(shape, dtype=torch.float64)
        draws = self._simulate(self.part, self.drawn, offsets, self.used)
        scale = self.fit.scale if self.anew is None else self.anew.noise_of(self._late(self.used))
        return draws + scale * torch.randn(draws.shape, dtype=torch.float64)


def _crps(draws: Tensor, observed: Tensor, mask: Tensor) -> float:
    """Returns the mean continuous ranked probability score, relative to each channel's range."""
    ranges = (observed * mask[..., None]).abs().amax((0, 1)).clamp_min(1e-12)
    return float((metrics.crps_by_step(draws, observed, mask, is_fair=True) / ranges).mean())
