"""The shape of a force's law, found from the recording.

A spring pulls to a rest position q₀ with −k (q − q₀), which is linear in k and k q₀. If it were
only tried at a few rest positions, a wrong stiffness would go with each of them, and a fit that
begins there could end as a constant force. So such a shape is solved for.

Other shapes are tried at many places of their priors, from the responses to pulses and without
any simulation. Wind has a direction and a speed. With few of each, wind at the arm of the Furuta
pendulum of seed 1160 had a twentieth of its gain, and an unbalance was found in its place.
"""

import math

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import PulseChanges
from npdr_ppl.language.effects import Effect, ForceEffect, LinearForceEffect
from npdr_ppl.language.reference import quantile

__all__ = ["force_shape"]

_LEAST_LEFT = 1e-6
"""Share of a column that others and refitted parameters must leave, above rounding errors."""

_TAIL = 0.001
"""Probability of the prior on each side outside which a shape is not tried: a fit that began there
would hardly move."""

_NUM_TRIED = 64
"""Shapes that are tried of a law that is not linear in other parameters: eight directions of the
wind for each of eight speeds. The gain falls to three quarters 30° from the right direction."""


def force_shape(projection: Projection, found: Responses, effect: Effect) -> dict[str, float]:
    """Returns the shape parameters with which a law explains most.

    The position of the joint must be measured. A measurement that is off by a constant shifts a
    rest position or a direction by as much.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        effect: The effect.

    Returns:
        Their values by name; empty if the recording does not determine them, or if they are
        outside their priors or go with a strength that is.
    """
    strengths = {parameter.name for parameter in effect.strengths}
    names = [p.name for p in effect.parameters if p.name not in strengths]
    if not isinstance(effect, ForceEffect) or not names or effect.port not in found.positions:
        return {}
    if isinstance(effect, LinearForceEffect):
        return _solved(projection, found, effect, names)
    return _tried(projection, found, effect, names)


def _solved(
    projection: Projection, found: Responses, effect: LinearForceEffect, names: list[str]
) -> dict[str, float]:
    """Returns the shape of a law that depends only on the position; else it is empty."""
    position = found.channels[found.positions[effect.port]]
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
    supports = {p.name: priors[p.name].support for p in effect.strengths}
    if any(s is not None and not bool(s.check(values[n])) for n, s in supports.items()):
        return {}
    ends = torch.tensor([_TAIL, 1.0 - _TAIL], dtype=torch.float64)
    for name in names:
        low, high = quantile(priors[name], ends).tolist()
        if not low <= float(values[name]) <= high:
            return {}
    return {name: float(values[name]) for name in names}


def _tried(
    projection: Projection, found: Responses, effect: ForceEffect, names: list[str]
) -> dict[str, float]:
    """Returns the best of many shapes of a law in proportion to one strength, without memory."""
    kind, rates = type(effect), _rates(projection, found, effect)
    is_plain = kind.initial_memory is ForceEffect.initial_memory and not effect.needs_joint
    has_dry = kind.dry_friction is not ForceEffect.dry_friction
    if len(effect.strengths) != 1 or not is_plain or has_dry or rates is None:
        return {}
    position = found.channels[found.positions[effect.port]]
    priors = effect.priors(projection.hypothesis.simulator.port(effect.port))
    points = torch.quasirandom.SobolEngine(len(names), scramble=True, seed=0).draw(_NUM_TRIED)
    points = _TAIL + (1.0 - 2.0 * _TAIL) * points.double()
    shapes = {name: quantile(priors[name], points[:, k]) for k, name in enumerate(names)}
    strength = effect.strengths[0].name
    # Engines pass laws one value per simulation of each argument.
    size = torch.Size((*position.shape, _NUM_TRIED))
    where, moving = (part[..., None].expand(size).flatten() for part in (position, rates))
    values = {name: value.expand(size).flatten() for name, value in shapes.items()}
    law = effect.force(
        where, moving, {**values, strength: torch.ones(size.numel()).double()}, None
    )
    if law is None:
        return {}
    scores = PulseChanges(projection, found.by_port[effect.port]).scores(law.reshape(size))
    information = scores.information.diagonal()
    sizes, support = scores.score / information.clamp_min(1e-300), priors[strength].support
    gains = torch.where(information > _LEAST_LEFT * scores.total, scores.score * sizes, -math.inf)
    if support is not None:
        gains = gains.masked_fill(~support.check(sizes), -math.inf)
    best = int(gains.nan_to_num(-math.inf).argmax())
    if not float(gains[best]) > 0.0:
        return {}
    return {name: float(values[best]) for name, values in shapes.items()}


def _rates(projection: Projection, found: Responses, effect: Effect) -> Tensor | None:
    """Returns the velocities of a joint at the pulses, ``(S, P)``.

    ``None`` if there is one pulse per segment only, and the velocity is not measured.
    """
    position = found.positions[effect.port]
    for sensor in projection.hypothesis.segments.measured:
        if sensor.rate_of == position:
            return found.channels[sensor.name]
    if found.time.shape[-1] < 2:
        return None
    return torch.gradient(found.channels[position], spacing=(found.time[0],), dim=-1)[0]
