"""Smooth forces at a joint, each a function of position q, velocity v and time t.

Signature: ``law(parameters, q, v, t)`` with arrays ``(R,)`` and t in s since the recording began.
The last ones are in no catalogue.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["FORCE_LAWS", "ForceLaw"]

Values = Mapping[str, float]

ForceLaw = Callable[[Values, Array, Array, float], Array]


def viscous_friction(p: Values, q: Array, v: Array, t: float) -> Array:
    """Resists in proportion to the speed."""
    return -p["damping"] * v


def quadratic_drag(p: Values, q: Array, v: Array, t: float) -> Array:
    """Resists in proportion to the squared speed."""
    return -np.copysign(p["drag"] * v**2, v)


def bias(p: Values, q: Array, v: Array, t: float) -> Array:
    """Pushes always the same."""
    return np.full_like(q, p["offset"])


def cogging(p: Values, q: Array, v: Array, t: float) -> Array:
    """Ripples over the angle."""
    amplitude, phase = math.hypot(p["sine"], p["cosine"]), math.atan2(p["cosine"], p["sine"])
    return amplitude * np.sin(p["order"] * q + phase)


def spring(p: Values, q: Array, v: Array, t: float) -> Array:
    """Pulls back to a rest position."""
    return p["stiffness"] * (p["rest"] - q)


def hardening_spring(p: Values, q: Array, v: Array, t: float) -> Array:
    """Pulls back to zero, ever harder."""
    return -p["stiffness"] * q**3


def unbalance(p: Values, q: Array, v: Array, t: float) -> Array:
    """Weight of an eccentric mass."""
    amplitude, phase = math.hypot(p["sine"], p["cosine"]), math.atan2(p["cosine"], p["sine"])
    return amplitude * np.sin(q + phase)


def wind(p: Values, q: Array, v: Array, t: float) -> Array:
    """Drag of air that moves past a lever at a steady speed."""
    relative = p["speed"] * np.cos(q - p["direction"]) - v
    return np.copysign(p["force"] * (relative / p["speed"]) ** 2, relative)


def periodic_disturbance(p: Values, q: Array, v: Array, t: float | Array) -> Array:
    """Shakes at one frequency."""
    angle = 2.0 * math.pi * p["frequency"] * t
    force = p["sine"] * np.sin(angle) + p["cosine"] * np.cos(angle)
    return np.full_like(q, force)


# In no catalogue.


def cubic_damping(p: Values, q: Array, v: Array, t: float) -> Array:
    """Resists in proportion to the cubed speed."""
    return -p["damping"] * v**3


def square_root_drag(p: Values, q: Array, v: Array, t: float) -> Array:
    """Resists in proportion to the root of the speed, rounded below 1 % of its scale."""
    floor = 0.01 * p["speed"]
    return -p["drag"] * v / np.sqrt(p["speed"] * np.sqrt(v**2 + floor**2))


def cross_term(p: Values, q: Array, v: Array, t: float) -> Array:
    """Resists on one side and drives on the other: −c q v."""
    return -p["coefficient"] * q * v


def hard_stop(p: Values, q: Array, v: Array, t: float) -> Array:
    """A rubber stop beyond |q| = q_s: stiff, and damped while it is pressed."""
    depth = np.abs(q) - p["position"]
    pressed = np.sign(q) * p["stiffness"] * depth + p["damping"] * v
    return np.where(depth > 0.0, -pressed, 0.0)


def detents(p: Values, q: Array, v: Array, t: float) -> Array:
    """Magnetic detents: short Gaussian wells, 2π/n apart, with nothing between them."""
    spacing = 2.0 * math.pi / p["count"]
    offset = q - spacing * np.round(q / spacing)
    scaled = offset / p["width"]
    return -p["force"] * scaled * np.exp(0.5 * (1.0 - scaled**2))


FORCE_LAWS: dict[str, ForceLaw] = {
    law.__name__: law
    for law in (
        viscous_friction,
        quadratic_drag,
        bias,
        cogging,
        spring,
        hardening_spring,
        unbalance,
        wind,
        periodic_disturbance,
        cubic_damping,
        square_root_drag,
        cross_term,
        hard_stop,
        detents,
    )
}
"""Laws by the effect's id."""
