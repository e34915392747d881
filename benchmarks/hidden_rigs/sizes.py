"""How large an effect of strength 1 is at a port, and what else about it is drawn by seed."""

import math
from collections.abc import Callable

import numpy as np

from hidden_rigs.hidden import Hidden
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Port

__all__ = ["COGGING_ORDERS", "drawn", "known_ids"]

Generator = np.random.Generator
Values = dict[str, float]
Size = Callable[[Port, float, Generator], Values]
"""Parameters at a port, for a strength s; everything else comes from the generator."""

COGGING_ORDERS = range(6, 25)
"""Periods of cogging per turn that a joint may have."""


def drawn(port: Port, effect_id: str, strength: float, generator: Generator) -> Hidden:
    """Returns an effect of some strength, its signs, phases and shapes drawn.

    The draws do not depend on the strength, which scales one and the same effect.

    Args:
        port: The port of the model under test.
        effect_id: The effect's id.
        strength: Multiple of a typical size, above 0.
        generator: Source of randomness.
    """
    if not strength > 0.0:
        raise ModelError(f"An effect that is hidden has a strength above 0, got {strength}.")
    if effect_id not in _SIZES:
        raise ModelError(f"No rig hides {effect_id!r}; there are {', '.join(sorted(_SIZES))}.")
    return Hidden(port.name, effect_id, _SIZES[effect_id](port, strength, generator))


def known_ids() -> tuple[str, ...]:
    """Returns the ids of all effects that rigs can hide."""
    return tuple(_SIZES)


def _sign(generator: Generator) -> float:
    return 1.0 if generator.random() < 0.5 else -1.0


def _around(generator: Generator, spread: float = 0.15) -> float:
    """Returns a factor near 1, so that no size is round."""
    return generator.uniform(1.0 - spread, 1.0 + spread)


def _share(name: str, share: float, powers: tuple[int, int] = (0, 0)) -> Size:
    """A share of the rated value, divided by powers of rated speed and rated position."""

    def size(port: Port, s: float, g: Generator) -> Values:
        scale = port.rated_speed ** powers[0] * port.rated_position ** powers[1]
        return {name: s * share * _around(g) * port.rated / scale}

    return size


def _plain(name: str, value: float) -> Size:
    """A number that no rated value scales."""
    return lambda port, s, g: {name: s * value * _around(g)}


def _signed(name: str, value: float, *, is_rated: bool) -> Size:
    """A number, or a share of the rated value, of either sign."""
    return lambda port, s, g: {
        name: s * value * _sign(g) * _around(g) * (port.rated if is_rated else 1.0)
    }


def _wave(share: float) -> Size:
    """An amplitude of random phase, as sine and cosine."""

    def size(port: Port, s: float, g: Generator) -> Values:
        phase = g.uniform(0.0, 2.0 * math.pi)
        amplitude = s * share * port.rated
        return {"sine": amplitude * math.cos(phase), "cosine": amplitude * math.sin(phase)}

    return size


def _cogging(port: Port, s: float, g: Generator) -> Values:
    return {**_wave(0.03)(port, s, g), "order": float(g.choice(COGGING_ORDERS))}


def _asymmetric(port: Port, s: float, g: Generator) -> Values:
    mean, difference = s * 0.05 * port.rated * _around(g), 0.3 * _sign(g)
    return {"forward": mean * (1.0 + difference), "backward": mean * (1.0 - difference)}


def _stribeck(port: Port, s: float, g: Generator) -> Values:
    # Rails are an order of magnitude slower than hinges in numbers.
    speed = (0.3 if port.coordinate == "rad" else 0.05) * _around(g)
    return {"excess": s * 0.05 * port.rated, "speed": speed}


def _presliding(port: Port, s: float, g: Generator) -> Values:
    deflection = 6e-3 * port.rated_position * _around(g)
    return {"magnitude": s * 0.05 * port.rated, "deflection": deflection, "relaxation": 1e-3}


def _saturation(port: Port, s: float, g: Generator) -> Values:
    return {"limit": port.rated * max(1.0 - 0.3 * s * _around(g), 0.1)}


def _spring(port: Port, s: float, g: Generator) -> Values:
    rest = g.uniform(-0.4, 0.4) * port.rated_position
    return {"stiffness": s * 0.06 * port.rated / port.rated_position, "rest": rest}


def _elasticity(port: Port, s: float, g: Generator) -> Values:
    values = {"damping_ratio": g.uniform(0.03, 0.08), "motor_share": g.uniform(0.25, 0.4)}
    return {"time_constant": s * 0.013, **values}  # 12 Hz


def _backlash(port: Port, s: float, g: Generator) -> Values:
    return {"play": s * 4e-3 * port.rated_position, "motor_share": g.uniform(0.25, 0.4)}


def _tilt(port: Port, s: float, g: Generator) -> Values:
    size = math.radians(2.0) * s
    return {"roll": _sign(g) * _around(g) * size, "pitch": _sign(g) * _around(g) * size}


def _wind(port: Port, s: float, g: Generator) -> Values:
    direction = g.uniform(-math.pi, math.pi)
    return {"force": s * 0.05 * port.rated, "speed": 10.0 * _around(g), "direction": direction}


def _periodic(port: Port, s: float, g: Generator) -> Values:
    return {**_wave(0.04)(port, s, g), "frequency": g.uniform(1.5, 4.0)}


def _bouc_wen(port: Port, s: float, g: Generator) -> Values:
    deflection = 0.3 * port.rated_position * _around(g)
    return {"magnitude": s * 0.08 * port.rated, "deflection": deflection, "asymmetry": 0.4}


def _uneven_friction(port: Port, s: float, g: Generator) -> Values:
    return {
        "magnitude": s * 0.05 * port.rated,
        "wave_number": 8.0 * _around(g) / port.rated_position,
    }


def _uneven_gain(port: Port, s: float, g: Generator) -> Values:
    # The port is that of the command, whose rated position is 1: radians, or metres for a rail.
    return {"depth": s * 0.15, "wave_number": _around(g) * (6.0 if port.unit != "V" else 3.0)}


def _root_drag(port: Port, s: float, g: Generator) -> Values:
    return {"drag": s * 0.06 * port.rated * _around(g), "speed": port.rated_speed}


def _cross_term(port: Port, s: float, g: Generator) -> Values:
    scale = port.rated / (port.rated_speed * port.rated_position)
    return {"coefficient": s * 0.15 * _sign(g) * scale}


def _bursts(port: Port, s: float, g: Generator) -> Values:
    return {"force": s * 0.3 * port.rated, "rate": 1.5, "duration": 0.06}


def _stop(port: Port, s: float, g: Generator) -> Values:
    # Stronger is nearer: the joint spends more of its time in it.
    stiffness = 2.0 * port.rated / port.rated_position
    position = 0.6 * port.rated_position * _around(g) / math.sqrt(s)
    damping = 0.05 * port.rated / port.rated_speed
    return {"position": position, "stiffness": stiffness, "damping": damping}


def _detents(port: Port, s: float, g: Generator) -> Values:
    count = (
        12.0 if port.coordinate == "rad" else round(2.0 * math.pi / (0.25 * port.rated_position))
    )
    return {"force": s * 0.08 * port.rated, "count": count, "width": 0.6 / count}


_SIZES: dict[str, Size] = {
    "viscous_friction": _share("damping", 0.1, (1, 0)),
    "coulomb_friction": _share("magnitude", 0.05),
    "asymmetric_coulomb_friction": _asymmetric,
    "stribeck_friction": _stribeck,
    "presliding_friction": _presliding,
    "quadratic_drag": _share("drag", 0.1, (2, 0)),
    "load_dependent_friction": _plain("coefficient", 0.08),
    "input_delay": _plain("delay", 0.01),
    "sensor_delay": _plain("delay", 0.01),
    "actuator_lag": _plain("time_constant", 0.015),
    "sensor_low_pass": _plain("time_constant", 0.01),
    "saturation": _saturation,
    "supply_sag": lambda port, s, g: {"sag": s * 0.12 * _around(g) / port.rated},
    "dead_zone": _share("width", 0.04),
    "actuator_gain": _signed("error", 0.08, is_rated=False),
    "bias": _signed("offset", 0.02, is_rated=True),
    "cogging": _cogging,
    "spring": _spring,
    "hardening_spring": _share("stiffness", 0.06, (0, 3)),
    "joint_elasticity": _elasticity,
    "backlash": _backlash,
    "payload": _share("mass", 0.2),
    "unbalance": _wave(0.04),
    "tilt": _tilt,
    "encoder_bias": _signed("offset", 0.01, is_rated=True),
    "encoder_scale": _signed("error", 0.01, is_rated=False),
    "clock_skew": _signed("skew", 5e-4, is_rated=False),
    "wind": _wind,
    "periodic_disturbance": _periodic,
    "parameter_drift": _signed("rate", 2e-3, is_rated=False),
    # In no catalogue.
    "bouc_wen_hysteresis": _bouc_wen,
    "position_dependent_friction": _uneven_friction,
    "cubic_damping": _share("damping", 0.12, (3, 0)),
    "square_root_drag": _root_drag,
    "cross_term": _cross_term,
    "hard_stop": _stop,
    "detents": _detents,
    "torque_bursts": _bursts,
    "position_dependent_gain": _uneven_gain,
    "asymmetric_gain": _signed("difference", 0.1, is_rated=False),
    "eccentric_encoder": lambda port, s, g: {
        "amplitude": s * 0.02 * port.rated,
        "phase": g.uniform(0.0, 2.0 * math.pi),
    },  # fmt: skip
}
