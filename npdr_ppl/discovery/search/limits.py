"""Finds laws whose shape parameter may be at its bound, where the law equals another law.

Friction that fades equals friction if it does not fade, a bristle that does not bend equals dry
friction, and a wave with a period of an hour equals a bias. If a recording is compatible with such
a bound, it does not show that this law is the cause. If the catalogue contains the law at the
bound, which has fewer parameters, the search has preferred it already.
"""

import math

from torch.distributions import constraints

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.settings import EVIDENCE
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.language.effects import Effect
from npdr_ppl.preparation.settings import LINEARISATION
from npdr_ppl.progress import Step
from npdr_ppl.rollouts import Rollouts

__all__ = ["limits"]

DISTINCT = 5.0
"""Loss of evidence at the other end above which the recording determines the parameter."""


def limits(
    current: Hypothesis,
    effect: Effect,
    trials: Trials,
    progress: Step = lambda fraction, status: None,
) -> tuple[str, ...]:
    """Returns the names of shape parameters that fit equally well at one end of their priors.

    All other parameters are refitted at each end (a profile likelihood).

    A parameter that fits at both ends is only unknown, and is left out. So are parameters between
    two bounds, such as a share or a damping ratio, because a device can have the value at a bound.
    Incidental parameters are left out too: bristles without damping are still bristles.

    For a wave's frequency only the low end is tested, because no other law is a fast wave. If no
    rollout lasts a period, another cause may look like the visible part of the wave.

    Args:
        current: The model with the effect, fitted.
        effect: The effect.
        trials: Fits the model.
        progress: Called with the fraction of the fits that is done.
    """
    if not effect.strength:
        return ()
    if effect.wave and not _is_seen_through(current, effect, current.segments.rollouts):
        return (effect.wave,)
    priors = effect.priors(current.simulator.port(effect.port))
    shapes = {
        site: parameter.name
        for site, parameter in zip(effect.parameter_names, effect.parameters, strict=True)
        if parameter.name not in (*effect.strength, *effect.incidental)
        and not isinstance(priors[parameter.name].support, constraints.interval)
    }
    ends = [
        {site: end}
        for site in shapes
        for end in (-LINEARISATION.start_limit, LINEARISATION.start_limit)
    ]
    best = current.losses(current.fit.scale).sum()
    lost = [
        math.inf
        if held is None
        else current.share * float(held.losses(current.fit.scale).sum() - best)
        for held in trials.holding(current, ends, progress)
    ]
    result = []
    for name, low, high in zip(shapes.values(), lost[::2], lost[1::2], strict=True):
        near, far = (low, math.inf) if name == effect.wave else (min(low, high), max(low, high))
        if near < EVIDENCE.indistinct_loss and far > DISTINCT:
            result.append(name)
    return tuple(result)


def _is_seen_through(current: Hypothesis, effect: Effect, rollouts: Rollouts) -> bool:
    """Returns whether a rollout lasts for at least one period of a wave."""
    frequency = float(current.parameters[f"{effect.name}.{effect.wave}"])
    return frequency * max(rollouts.lengths) * rollouts.time_step >= 1.0
