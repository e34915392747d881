"""Finds priors that do not contain the recording's parameters, by a fit with wider priors.

If the closest fit is at an end of a prior, the prior may be too narrow, or the parameter may
compensate for an effect that the model lacks. Both leave a misfit. To distinguish them, the priors
with the fit at their ends are widened and the model is fitted again.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy import stats
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_segment_model
from npdr_ppl.discovery.search.settings import PRIOR_ENDS
from npdr_ppl.discovery.search.trials import Trials, refit
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.model import Model
from npdr_ppl.language.wider_priors import (
    described_prior,
    widened,
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
    "with_wider_effects",
    "with_widest_priors",
]


@dataclass(frozen=True)
class PriorEnd:
    """A parameter that fits better beyond the end of its prior.

    Attributes:
        name: Its latent site.
        end: ``"lower"`` or ``"upper"``.
        prior: The prior in readable form.
        closest: The value of the fit with a wider prior, in the parameter's unit.
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
    if fitted is None or _gain(current, fitted) < _threshold(names):
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
    return found is not None and _gain(found, chosen) < _threshold(names)


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
        own = _at_end(current)
        if not own:
            break
        wider = with_wider_priors(current.segments.model, own)
        fitted = _refitted(current, wider, is_rough=is_rough)
        if fitted is None or ratio * _gain(current, fitted) < _threshold(own):
            break
        current = fitted
        names.update(own)
    return current, frozenset(names)


def with_wider_effects(
    trials: Trials, current: Hypothesis, *, is_trial: bool = False
) -> Hypothesis:
    """Widens priors of effects' strengths that have a fit at an end, if it then fits better.

    How strong a missing effect is, its prior cannot know. If the prior ends before, another effect
    explains the rest. Shapes keep their priors: an implausible one shows that a law is wrong.

    Args:
        trials: Fits the model.
        current: The closest fit of the model with effects.
        is_trial: Whether a short fit is enough.
    """
    for _ in range(PRIOR_ENDS.most_widenings):
        at_end = set(_at_end(current, near=PRIOR_ENDS.outside_coordinate))
        effects, asked = [], set[str]()
        for effect in current.effects:
            own = [p.name for p in effect.strengths if f"{effect.name}.{p.name}" in at_end]
            port = current.simulator.port(effect.port)
            effects.append(effect.with_wider_priors(port, own) if own else effect)
            asked.update(own)
        if not asked:
            break
        segments = trials.with_effects(tuple(effects), current.segments.starts)
        if segments is None:
            break
        fit = replace(refit(segments, current, tuple(effects), {}), is_trial=is_trial)
        (fitted,) = trials.fits([fit], current.simulator)
        if fitted is None or _gain(current, fitted) < _threshold(asked):
            break
        current = fitted
    return current


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


def _threshold(names: Collection[str]) -> float:
    """Returns a gain that so many free parameters exceed by chance at the false-alarm rate."""
    return 0.5 * float(stats.chi2.isf(PRIOR_ENDS.false_alarm_rate, len(names)))


def _at_end(hypothesis: Hypothesis, *, near: float = PRIOR_ENDS.near_coordinate) -> list[str]:
    """Returns the scalar sites whose fit is near an end that a wider prior would move.

    Args:
        hypothesis: The fit.
        near: Absolute reference coordinate from which a parameter is near an end.
    """
    z, found = hypothesis.fit.z, []
    for site in hypothesis.segments.prior.sites:
        if site.shape.numel() != 1:
            continue
        place = float(z[site.coordinates][0])
        prior = hypothesis.segments.prior.distributions[site.name]
        is_near = abs(place) > near and widened(prior) is not None
        if is_near and _is_movable(prior, is_lower=place < 0.0):
            found.append(site.name)
    return found


def _is_movable(prior: Any, *, is_lower: bool) -> bool:
    """Returns whether a wider prior has more probability beyond an end.

    It has not below a prior that begins at zero, such as that of a friction.
    """
    wider, share = widened(prior), PRIOR_ENDS.outside_probability
    if wider is None:
        return getattr(prior.support, "lower_bound" if is_lower else "upper_bound", None) is None
    try:
        end = prior.icdf(torch.as_tensor(share if is_lower else 1.0 - share))
    except NotImplementedError:  # torch knows no quantiles of this family
        return True
    below = _probability_below(wider, end)
    if below is None:
        return True
    return below > share if is_lower else below < 1.0 - share


def _gain(before: Hypothesis, after: Hypothesis) -> float:
    """Returns the increase of the log likelihood, at the residual scale of the later fit."""
    scale = after.fit.scale
    return after.share * float((before.losses(scale) - after.losses(scale)).sum())


def beyond(priors: Mapping[str, Any], found: Hypothesis) -> tuple[PriorEnd, ...]:
    """Returns the parameters whose fitted values are beyond ends that wider priors would move."""
    ends = []
    for name, value in found.parameters.items():
        if name not in priors:  # a parameter of an added effect
            continue
        below = _probability_below(priors[name], value) if value.numel() == 1 else None
        if (
            below is None
            or PRIOR_ENDS.outside_probability < below < 1.0 - PRIOR_ENDS.outside_probability
        ):
            continue
        end = "lower" if below <= PRIOR_ENDS.outside_probability else "upper"
        if not _is_movable(priors[name], is_lower=end == "lower"):
            continue
        ends.append(PriorEnd(name, end, described_prior(priors[name]), float(value)))
    return tuple(ends)


def _probability_below(prior: Any, value: Tensor) -> float | None:
    """Returns the prior probability of a smaller value, ``None`` if it is not known."""
    try:
        # Torch rejects values outside a range, so they are moved to its bounds.
        low, high = torch.as_tensor(prior.support.lower_bound), prior.support.upper_bound
        value = value.flatten()[:1].to(low).maximum(low).minimum(torch.as_tensor(high))
    except AttributeError:
        value = value.flatten()[:1]
    try:
        return float(prior.cdf(value).flatten()[0])
    except (NotImplementedError, ValueError):
        return None
