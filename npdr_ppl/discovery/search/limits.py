"""Laws that are not more than a limit of their own, where another law may be.

Friction that fades is friction as long as it does not fade, a bristle that does not bend is dry
friction, a wave that takes an hour is a bias. A recording that says nothing against such a limit
does not say that it is this law; and where the catalogue has the law of the limit, which needs
less, that one has been preferred.
"""

import math

from torch.distributions import constraints

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.search.evidence import INDISTINCT
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.language.effects import Effect
from npdr_ppl.preparation.segment_model import START_LIMIT
from npdr_ppl.rollouts import Rollouts

__all__ = ["limits"]

DISTINCT = 5.0
"""Loss of evidence at the other end from which it says something about the parameter at all."""


def limits(current: Hypothesis, effect: Effect, trials: Trials) -> tuple[str, ...]:
    """Returns the names of an effect's shapes that may as well be at one end of their priors.

    All other parameters are refitted there (a profile likelihood). Shapes that may be anywhere
    are only unknown; the law needs them nowhere. Those between two bounds have no limit: at its
    bounds a share or a damping ratio is a device's as well. Incidental ones do not count: bristles
    without damping are bristles. Of a wave's frequency the low end does: no other law is a fast
    wave; and where no rollout lasts a period, something else may bend like the part that is seen.

    Args:
        current: The model with the effect, fitted.
        effect: The effect.
        trials: Fits the model.
    """
    if not effect.strength:
        return ()
    if effect.wave and not _is_seen_through(current, effect, trials.rollouts):
        return (effect.wave,)
    priors = effect.priors(current.simulator.port(effect.port))
    shapes = {
        site: parameter.name
        for site, parameter in zip(effect.parameter_names, effect.parameters, strict=True)
        if parameter.name not in (*effect.strength, *effect.incidental)
        and not isinstance(priors[parameter.name].support, constraints.interval)
    }
    ends = [{site: end} for site in shapes for end in (-START_LIMIT, START_LIMIT)]
    best = current.losses(current.fit.scale).sum()
    lost = [
        math.inf
        if held is None
        else current.share * float(held.losses(current.fit.scale).sum() - best)
        for held in trials.holding(current, ends)
    ]
    result = []
    for name, low, high in zip(shapes.values(), lost[::2], lost[1::2], strict=True):
        near, far = (low, math.inf) if name == effect.wave else (min(low, high), max(low, high))
        if near < INDISTINCT and far > DISTINCT:
            result.append(name)
    return tuple(result)


def _is_seen_through(current: Hypothesis, effect: Effect, rollouts: Rollouts) -> bool:
    """Returns whether a rollout lasts for a period of a wave."""
    frequency = float(current.parameters[f"{effect.name}.{effect.wave}"])
    return frequency * max(rollouts.lengths) * rollouts.time_step >= 1.0
