"""Priors that end before the recording's parameters: found by fitting with wider ones.

A closest fit at an end of a prior may mean that the prior is too narrow, or that a parameter
makes up for an effect that the model lacks. Both leave a misfit, so it is tried: the priors at
whose ends the fit lies are widened and the model is fitted again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from scipy import stats
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, Model, fit_hypothesis
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.errors import NpdrError
from npdr_ppl.language.wider_priors import described_prior, widened, with_wider_priors
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts

__all__ = ["PriorEnd", "Widened", "beyond", "widen_where_it_helps"]

NEAR_END = 1.64
"""Reference coordinate from which a parameter lies near an end of its prior: in the outermost 5 %
on either side. Only these are tried, which costs one fit."""

FALSE_ALARM_RATE = 1e-3
"""Probability that a prior which holds the truth is called too narrow, of a likelihood ratio."""

OUTSIDE = 1e-3
"""Prior probability beyond a value at which it counts as outside the prior."""

MOST_WIDENINGS = 3
"""How often priors are widened, each time threefold."""


@dataclass(frozen=True)
class PriorEnd:
    """A parameter that would lie beyond the end of its prior.

    Attributes:
        name: Its latent site.
        end: ``"lower"`` or ``"upper"``.
        prior: The prior as a person would write it.
        closest: Where the wider prior's fit puts it, in the parameter's unit.
    """

    name: str
    end: str
    prior: str
    closest: float

    def __str__(self) -> str:
        return (
            f"{self.name} is at the {self.end} end of its prior, {self.prior}; the recording asks "
            f"for about {self.closest:.4g}: widen it"
        )


@dataclass(frozen=True)
class Widened:
    """What wider priors gave.

    Attributes:
        model: The model with wider priors.
        hypothesis: Its closest fit.
        ends: The parameters that lie beyond their priors.
    """

    model: Model
    hypothesis: Hypothesis
    ends: tuple[PriorEnd, ...]


def widen_where_it_helps(
    model: Model, current: Hypothesis, rollouts: Rollouts, binding: DataOptions
) -> Widened | None:
    """Widens the priors at whose ends a fit lies, if the recording then fits better.

    Args:
        model: The model without the effects of the hypothesis.
        current: Its closest fit.
        rollouts: The recording.
        binding: Its segments.

    Returns:
        ``None`` where no prior ends too early.
    """
    result: Widened | None = None
    priors = current.segments.prior.distributions
    for _ in range(MOST_WIDENINGS):
        names = [name for name in _at_end(current) if widened(priors[name]) is not None]
        if not names:
            break
        wider = with_wider_priors(model, names)
        try:
            fitted = fit_hypothesis(
                wider,
                rollouts,
                binding,
                start=current.parameters,
                offsets=current.fit.offsets,
                starts=current.segments.starts,
            )
        except NpdrError:
            break
        threshold = 0.5 * float(stats.chi2.isf(FALSE_ALARM_RATE, len(names)))
        if _gain(current, fitted) < threshold:
            break
        fitted = Trials(wider, rollouts, binding).with_own_starts(fitted)
        model, current = wider, fitted
        result = Widened(model, current, beyond(priors, current))
    return result if result is not None and result.ends else None


def _at_end(hypothesis: Hypothesis) -> list[str]:
    """Returns the scalar sites that lie near an end of their priors."""
    z = hypothesis.fit.z
    return [
        site.name
        for site in hypothesis.segments.prior.sites
        if site.shape.numel() == 1 and bool((z[site.coordinates].abs() > NEAR_END).all())
    ]


def _gain(before: Hypothesis, after: Hypothesis) -> float:
    """Returns by how much the log likelihood grows, at the scale that the later fit leaves."""
    scale = after.fit.scale
    return after.share * float((before.losses(scale) - after.losses(scale)).sum())


def beyond(priors: Mapping[str, Any], found: Hypothesis) -> tuple[PriorEnd, ...]:
    """Returns the parameters that a fit puts outside their priors."""
    ends = []
    for name, value in found.parameters.items():
        if name not in priors:  # an effect that was added
            continue
        below = _probability_below(priors[name], value) if value.numel() == 1 else None
        if below is None or OUTSIDE < below < 1.0 - OUTSIDE:
            continue
        end = "lower" if below <= OUTSIDE else "upper"
        ends.append(PriorEnd(name, end, described_prior(priors[name]), float(value)))
    return tuple(ends)


def _probability_below(prior: Any, value: Tensor) -> float | None:
    """Returns the prior probability of a smaller value, ``None`` where it is not known."""
    try:
        # Values outside a range have no cumulative probability in torch's checks.
        low, high = torch.as_tensor(prior.support.lower_bound), prior.support.upper_bound
        value = value.flatten()[:1].to(low).maximum(low).minimum(torch.as_tensor(high))
    except AttributeError:
        value = value.flatten()[:1]
    try:
        return float(prior.cdf(value).flatten()[0])
    except (NotImplementedError, ValueError):
        return None
