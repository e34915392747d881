"""Which parameters of a closest fit are at an end of their priors, and what a wider one gains."""

from collections.abc import Collection
from typing import Any

import torch
from scipy import stats
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.settings import PRIOR_ENDS
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.wider_priors import widened

__all__ = [
    "gain",
    "is_movable",
    "probability_below",
    "sites_at_end",
    "threshold",
    "with_wider_strengths",
]


def sites_at_end(hypothesis: Hypothesis, *, near: float = PRIOR_ENDS.near_coordinate) -> list[str]:
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
        if is_near and is_movable(prior, is_lower=place < 0.0):
            found.append(site.name)
    return found


def with_wider_strengths(hypothesis: Hypothesis) -> tuple[tuple[Effect, ...], frozenset[str]]:
    """Returns the effects with wider priors of strengths that have the fit at an end.

    A prior cannot know how strong a missing effect is. If it ends too early, another effect is
    added for the rest. Shapes keep their priors: an implausible one shows that a law is wrong.

    Args:
        hypothesis: The closest fit of a model with effects.

    Returns:
        All effects, and the sites whose priors are wider.
    """
    at_end = set(sites_at_end(hypothesis, near=PRIOR_ENDS.outside_coordinate))
    effects, sites = [], set[str]()
    for effect in hypothesis.effects:
        own = {f"{effect.name}.{p.name}": p.name for p in effect.strengths}
        wide = at_end & own.keys()
        names = [name for site, name in own.items() if site in wide]
        port = hypothesis.simulator.port(effect.port)
        effects.append(effect.with_wider_priors(port, names) if names else effect)
        sites |= wide
    return tuple(effects), frozenset(sites)


def is_movable(prior: Any, *, is_lower: bool) -> bool:
    """Returns whether a wider prior has more probability beyond an end.

    It has none below a prior that begins at zero, such as that of a friction.
    """
    wider, share = widened(prior), PRIOR_ENDS.outside_probability
    if wider is None:
        return getattr(prior.support, "lower_bound" if is_lower else "upper_bound", None) is None
    try:
        end = prior.icdf(torch.as_tensor(share if is_lower else 1.0 - share))
    except NotImplementedError:  # torch knows no quantiles of this family
        return True
    below = probability_below(wider, end)
    if below is None:
        return True
    return below > share if is_lower else below < 1.0 - share


def gain(before: Hypothesis, after: Hypothesis) -> float:
    """Returns the increase of the log likelihood, at the residual scale of the later fit."""
    scale = after.fit.scale
    return after.share * float((before.losses(scale) - after.losses(scale)).sum())


def threshold(names: Collection[str]) -> float:
    """Returns a gain that so many free parameters exceed by chance at the false-alarm rate."""
    return 0.5 * float(stats.chi2.isf(PRIOR_ENDS.false_alarm_rate, len(names)))


def probability_below(prior: Any, value: Tensor) -> float | None:
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
