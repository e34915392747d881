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

_LEAST_LEFT = 1e-6
"""Share of a column that others and refitted parameters must leave, above rounding errors."""

_TAIL = 0.001
"""Probability of the prior on each side outside which a shape is not tried: a fit that began there
would hardly move."""


def linear_shape(projection: Projection, found: Responses, effect: Effect) -> dict[str, float]:
    """Returns the shape parameters with which a law explains most.

    The law must be linear in other parameters, and depend only on the position of a joint that is
    measured. A measurement that is off by a constant shifts a rest position by as much.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        effect: The effect.

    Returns:
        Their values by name; empty if the recording does not determine them, or if they are
        outside their priors or go with a strength that is.
    """
    channel = found.positions.get(effect.port)
    strengths = {parameter.name for parameter in effect.strengths}
    names = [p.name for p in effect.parameters if p.name not in strengths]
    if not isinstance(effect, LinearForceEffect) or not names or channel is None:
        return {}
    position = found.channels[channel]
    one, *others = (
        torch.stack(effect.columns(position, torch.full_like(position, velocity)), dim=-1)
        for velocity in (1.0, -1.0, 2.0)
    )
    if not all(torch.equal(one, other) for other in others):  # it depends on the velocity
        return {}
    scores = projection.scores(found.by_port[effect.port] @ one)
    size = scores.information.diagonal().clamp_min(0.0).sqrt()
    alike = scores.information / (size * size[:, None]).clamp_min(1e-300)
    left = torch.minimum(torch.linalg.eigvalsh(alike)[0], 1.0 - scores.absorbed.max())
    if not float(left) > _LEAST_LEFT:
        return {}
    base = torch.linalg.solve(scores.information, scores.score)
    values = effect.from_base(tuple(base.unbind()))
    priors = effect.priors(projection.hypothesis.simulator.port(effect.port))
    supports = {name: priors[name].support for name in strengths}
    if any(s is not None and not bool(s.check(values[n])) for n, s in supports.items()):
        return {}
    ends = torch.tensor([_TAIL, 1.0 - _TAIL], dtype=torch.float64)
    for name in names:
        low, high = quantile(priors[name], ends).tolist()
        if not low <= float(values[name]) <= high:
            return {}
    return {name: float(values[name]) for name in names}
