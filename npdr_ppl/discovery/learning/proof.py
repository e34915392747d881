"""Whether a learned law helps on measurements that it was not fitted to.

The terms of the law are chosen from the whole recording, and its constants are fitted to one half
at a time. So the halves check the constants, and only held-out rollouts check the terms as well.
"""

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


@dataclass(frozen=True)
class Check:
    """The misfit of measurements to which the constants of neither of two models were fitted.

    Attributes:
        where: Which measurements.
        before: Misfit of the model without the law, over its number of measurements.
        after: Misfit of the model with it.
    """

    where: str
    before: float
    after: float

    @property
    def helps(self) -> bool:
        """Whether the law reduces the misfit."""
        return self.after < self.before

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        return {"where": self.where, "before": self.before, "after": self.after}


def misfit(hypothesis: Hypothesis, segments: SegmentModel, scale: Tensor) -> float:
    """Returns the misfit of a fitted model along other segments, over the number of measurements.

    The segments' initial states are estimated from their own measurements.

    Args:
        hypothesis: The fitted model.
        segments: A model along the other segments.
        scale: Standard deviation of each channel, ``(C,)``.
    """
    own = segments.with_model(hypothesis.model)
    fit = SegmentFit(hypothesis.fit.z, own.no_offsets, scale)
    there = Hypothesis(hypothesis.model, hypothesis.effects, own, fit)
    if not there.can_be_linearised:
        return float("inf")
    nothing = torch.zeros(len(fit.z), dtype=torch.bool)
    return Projection(there, nothing).misfit / float(own.num_measured.sum())


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
        found: list[float] = []
        for hypothesis in (before, after):
            half = hypothesis.segments.along(parts[fitted])
            try:
                own = fit_segment_model(
                    half,
                    effects=hypothesis.effects,
                    start=hypothesis.parameters,
                    offsets=hypothesis.fit.offsets[parts[fitted]],
                )
                found.append(misfit(own, hypothesis.segments.along(parts[other]), scale))
            except DataError:
                found.append(float("inf"))
        result.append(Check(other, found[0], found[1]))
    if holdout is not None and options is not None:
        segments = SegmentModel(before.model, holdout, options)
        both = (misfit(h, segments, scale) for h in (before, after))
        result.append(Check("the held-out rollouts", *both))
    return result
