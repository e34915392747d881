"""The shape of a law that is linear in other parameters, found from the recording.

A spring pulls to a rest position q₀ with −k (q − q₀), which is linear in k and k q₀. If it were
only tried at a few rest positions, a wrong stiffness would go with each of them, and a fit that
begins there could end as a constant force.
"""

import torch

from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.language.effects import Effect, LinearForceEffect
from npdr_ppl.language.reference import quantile

__all__ = ["linear_shape"]

_TAIL = 0.001
"""Probability beyond each end of the values that a shape may have."""


def linear_shape(projection: Projection, found: Responses, effect: Effect) -> dict[str, float]:
    """Returns the shape parameters with which a law explains most; empty if they are not told.

    They are told if the law is linear in other parameters and depends on the joint's position
    only, which is measured, and if strengths and shape are such as the priors allow.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        effect: The effect.
    """
    channel = found.positions.get(effect.port)
    strengths = {parameter.name for parameter in effect.strengths}
    names = [p.name for p in effect.parameters if p.name not in strengths]
    if not isinstance(effect, LinearForceEffect) or not names or channel is None:
        return {}
    position = found.channels[channel]
    columns = torch.stack(effect.columns(position, torch.full_like(position, torch.nan)), dim=-1)
    if not bool(columns.isfinite().all()):  # the law depends on the velocity
        return {}
    scores = projection.scores(found.by_port[effect.port] @ columns)
    base = torch.linalg.pinv(scores.information, hermitian=True) @ scores.score
    values = effect.from_base(tuple(base.unbind()))
    priors = effect.priors(projection.hypothesis.simulator.port(effect.port))
    ends = torch.tensor([_TAIL, 1.0 - _TAIL], dtype=torch.float64)
    for name, value in values.items():
        prior = priors[name]
        low, high = quantile(prior, ends).tolist()
        # A strength may be near zero, but not of the wrong sign.
        is_low = not prior.support.check(value) if name in strengths else float(value) < low
        if bool(is_low) or float(value) > high:
            return {}
    return {name: float(values[name]) for name in names if name in values}
