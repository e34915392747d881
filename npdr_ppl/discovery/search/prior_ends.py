"""Finds priors that do not contain the recording's parameters, by a fit with wider priors.

If the closest fit is at an end of a prior, the prior may be too narrow, or the parameter may
compensate for an effect that the model lacks. Both leave a misfit. To distinguish them, the priors
with the fit at their ends are widened and the model is fitted again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_segment_model
from npdr_ppl.discovery.search.fits_at_ends import (
    gain,
    is_movable,
    probability_below,
    sites_at_end,
    threshold,
)
from npdr_ppl.discovery.search.settings import PRIOR_ENDS
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import (
    described_prior,
    wider_sites,
    with_wider_priors,
)
from npdr_ppl.preparation.closest_fit import part_of
from npdr_ppl.preparation.segment_model import SegmentModel

__all__ = [
    "PriorEnd",
    "Widened",
    "beyond",
    "own_priors_suffice",
    "widen_where_it_helps",
    "with_widest_priors",
]


@dataclass(frozen=True)
class PriorEnd:
    """A parameter whose fit is at or beyond an end of its prior.

    Attributes:
        name: Its latent site.
        end: ``"lower"`` or ``"upper"``.
        prior: The prior in readable form.
        closest: The value of the fit, in the parameter's unit.
    """

    name: str
    end: str
    prior: str
    closest: float

    def __str__(self) -> str:
        return (
            f"{self.name} fits best at about {self.closest:.4g} with wider priors, at or beyond "
            f"the {self.end} end of its prior, {self.prior}: widen the prior"
        )

    @property
    def decisive(self) -> str:
        """A sentence for a fit that stays in the prior, because a wider one was not needed."""
        return (
            f"{self.name} is at the {self.end} end of its prior, {self.prior}. The prior, and not "
            "the recording, may therefore determine it and the parameters that compensate for it. "
            "Widen the prior if the robot can have such a value."
        )


@dataclass(frozen=True)
class Widened:
    """The result of widening priors.

    Attributes:
        segments: The model with wider priors, along the recording.
        hypothesis: Its closest fit.
        ends: The parameters that are outside their original priors.
    """

    segments: SegmentModel
    hypothesis: Hypothesis
    ends: tuple[PriorEnd, ...]


def widen_where_it_helps(base: SegmentModel, current: Hypothesis) -> Widened | None:
    """Widens the priors that have the fit at an end, if the model then fits better.

    Args:
        base: The model without the effects of the hypothesis, along the recording.
        current: Its closest fit.

    Returns:
        The result, or ``None`` if no prior is too narrow.
    """
    priors, num = current.segments.prior.distributions, current.segments.inputs.num_segments
    # A part of the segments shows how far to widen.
    index = part_of(current.segments)
    # Parameters that are free to fit the part fit it better than those of the whole recording.
    begun = _refitted(current.along(index), base.model) or current.along(index)
    widest, names = with_widest_priors(begun, ratio=num / len(index))
    if not names:
        return None
    model = widest.segments.model
    fitted = _refitted(current, model, widest.parameters)
    if fitted is None or gain(current, fitted) < threshold(names):
        return None
    wider_base = base.with_model(model)
    found = Trials(wider_base).with_own_starts(fitted)
    ends = beyond(priors, found)
    return Widened(wider_base, found, ends) if ends else None


def own_priors_suffice(own: SegmentModel, model: Hypothesis, chosen: Hypothesis) -> bool:
    """Returns whether a model with effects fits as well in priors that were not widened.

    Args:
        own: The model with these priors and without the effects, along the recording.
        model: The closest fit of the model with effects and wider priors.
        chosen: The fit with wider priors, of the same or other effects, to compare it with.
    """
    before, now = (wider_sites(each) for each in (own.model, model.segments.model))
    names = {name for sites in now[len(before) :] for name in sites}
    found = Trials(own).refitted(model)
    return found is not None and gain(found, chosen) < threshold(names)


def with_widest_priors(
    current: Hypothesis, *, ratio: float = 1.0, is_rough: bool = False
) -> tuple[Hypothesis, frozenset[str]]:
    """Widens the priors that have a fit at an end, as long as the model then fits better.

    Args:
        current: The closest fit of a model without added effects.
        ratio: How many times as many segments the recording has.
        is_rough: Whether rough fits are enough.

    Returns:
        The fit with the widest priors that help, and the sites whose priors were widened.
    """
    names: set[str] = set()
    for _ in range(PRIOR_ENDS.most_widenings):
        own = sites_at_end(current)
        if not own:
            break
        wider = with_wider_priors(current.segments.model, own)
        fitted = _refitted(current, wider, is_rough=is_rough)
        if fitted is None or ratio * gain(current, fitted) < threshold(own):
            break
        current = fitted
        names.update(own)
    return current, frozenset(names)


def _refitted(
    current: Hypothesis,
    model: Model,
    start: Mapping[str, Tensor] | None = None,
    *,
    is_rough: bool = False,
) -> Hypothesis | None:
    """Fits another model along a hypothesis's segments; ``None`` if it cannot be simulated.

    Args:
        current: The hypothesis, from whose parameters the fit begins by default.
        model: The other model.
        start: Parameters from which the fit begins instead.
        is_rough: Whether a rough fit is enough.
    """
    try:
        return fit_segment_model(
            current.segments.with_model(model),
            start=start or current.parameters,
            offsets=current.fit.offsets,
            is_rough=is_rough,
        )
    except NpdrError:
        return None


def beyond(priors: Mapping[str, Any], found: Hypothesis) -> tuple[PriorEnd, ...]:
    """Returns the parameters whose fitted values are beyond ends that wider priors would move."""
    ends = []
    for name, value in found.parameters.items():
        if name not in priors:  # a parameter of an added effect
            continue
        below = probability_below(priors[name], value) if value.numel() == 1 else None
        if (
            below is None
            or PRIOR_ENDS.outside_probability < below < 1.0 - PRIOR_ENDS.outside_probability
        ):
            continue
        end = "lower" if below <= PRIOR_ENDS.outside_probability else "upper"
        if not is_movable(priors[name], is_lower=end == "lower"):
            continue
        ends.append(PriorEnd(name, end, described_prior(priors[name]), float(value)))
    return tuple(ends)
