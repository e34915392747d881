"""Whether a learned law helps on measurements that it was not fitted to.

The terms of the law are chosen from the whole recording, and its constants are fitted to one half
at a time. So the halves check the constants, and only held-out rollouts check the terms as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_segment_model
from npdr_ppl.discovery.learning.learn import LearnedModel
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.evidence import closest
from npdr_ppl.discovery.search.repeatability import HALVES, halves
from npdr_ppl.errors import DataError
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_fit import SegmentFit
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts

__all__ = ["Check", "checks", "misfit"]


SIGNIFICANT = 2.0
"""Standard deviations by which a law must reduce a misfit: noise alone does with a probability of
2 %."""


@dataclass(frozen=True)
class Check:
    """The misfit of measurements to which the constants of neither of two models were fitted.

    Attributes:
        where: Which measurements.
        before: Misfit of the model without the law, over its number of measurements.
        after: Misfit of the model with it.
        noise: Standard deviation of the difference from the noise of the measurements.
    """

    where: str
    before: float
    after: float
    noise: float = 0.0

    @property
    def helps(self) -> bool:
        """Whether the law reduces the misfit by more than the noise does."""
        return self.before - self.after > SIGNIFICANT * self.noise

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        return {
            "where": self.where,
            "before": self.before,
            "after": self.after,
            "noise": self.noise,
        }


def misfit(hypothesis: Hypothesis, segments: SegmentModel, scale: Tensor) -> float:
    """Returns the misfit of a fitted model along other segments, over the number of measurements.

    The segments' initial states are estimated from their own measurements.

    Args:
        hypothesis: The fitted model.
        segments: A model along the other segments.
        scale: Standard deviation of each channel, ``(C,)``.
    """
    residual = _residual(hypothesis, segments, scale)
    return _mean_square(residual, segments)


def _residual(hypothesis: Hypothesis, segments: SegmentModel, scale: Tensor) -> Tensor | None:
    """Returns residuals of independent components, ``(S, N)``; ``None`` if simulations fail."""
    own = segments.with_model(hypothesis.model)
    fit = SegmentFit(hypothesis.fit.z, own.no_offsets, scale)
    there = Hypothesis(hypothesis.model, hypothesis.effects, own, fit)
    if not there.can_be_linearised:
        return None
    projection = Projection(there, torch.zeros(len(fit.z), dtype=torch.bool))
    return projection.whitened(projection.residual[..., None])[..., 0]


def _mean_square(residual: Tensor | None, segments: SegmentModel) -> float:
    if residual is None:
        return float("inf")
    return float(residual.square().sum()) / float(segments.num_measured.sum())


def _check(
    where: str,
    segments: SegmentModel,
    both: Sequence[Hypothesis | None],
    scale: Tensor,
    share: float,
) -> Check:
    """Compares two models on measurements.

    If the truth is half-way between them, their residuals are e ± δ/2 with the noise e. The
    difference of their misfits is then 2 e · δ, of standard deviation 2 |δ|. Of dependent
    measurements, only a share counts.

    Args:
        where: Which measurements.
        segments: A model along them.
        both: The model without the law and with it; ``None`` if it could not be fitted.
        scale: Standard deviation of each channel, ``(C,)``.
        share: Number of independent measurements, as a share of all.
    """
    before, after = (None if h is None else _residual(h, segments, scale) for h in both)
    noise = 0.0
    if before is not None and after is not None:
        size = float((before - after).norm())
        noise = 2.0 * size / share**0.5 / float(segments.num_measured.sum())
    return Check(where, _mean_square(before, segments), _mean_square(after, segments), noise)


def checks(
    model: LearnedModel, holdout: Rollouts | None, options: DataOptions | None
) -> list[Check]:
    """Returns the checks: each half with the model fitted to the other, and the held-out rollouts.

    Args:
        model: The model with the laws, and without.
        holdout: The held-out recording, if there is one.
        options: How it is cut into segments.
    """
    before, after = model.start, model.hypothesis
    scale = closest([before, after]).fit.scale
    parts = dict(halves(before.segments.inputs.num_segments))
    result = []
    for fitted, other in (HALVES, HALVES[::-1]):
        found: list[Hypothesis | None] = []
        for hypothesis in (before, after):
            half = hypothesis.segments.along(parts[fitted])
            try:
                own = fit_segment_model(
                    half,
                    effects=hypothesis.effects,
                    start=hypothesis.parameters,
                    offsets=hypothesis.fit.offsets[parts[fitted]],
                )
            except DataError:
                own = None
            found.append(own)
        segments = before.segments.along(parts[other])
        result.append(_check(other, segments, found, scale, after.share))
    if holdout is not None and options is not None:
        segments = SegmentModel(before.model, holdout, options)
        where = "the held-out rollouts"
        result.append(_check(where, segments, (before, after), scale, after.share))
    return result
