"""Effects in words: ``"velocity low-pass, 19 ms"`` instead of a port, an id and a table."""

import math
import re
from collections.abc import Mapping
from typing import Any

from npdr_ppl.drawing.numbers import number

__all__ = [
    "TITLES",
    "cause_in_words",
    "effect_label",
    "effect_title",
    "in_words",
    "quantity",
    "why_unnamed",
]

TITLES = {
    "actuator_gain": "{where} gain error",
    "actuator_lag": "{where} lag",
    "asymmetric_coulomb_friction": "dry friction of unequal directions at {joint}",
    "backlash": "backlash at {joint}",
    "base_compliance": "carrier of {joint} that yields",
    "bias": "constant force at {joint}",
    "clock_skew": "clock error",
    "cogging": "cogging at {joint}",
    "contact": "other contact of {where}",
    "coulomb_friction": "dry friction at {joint}",
    "dead_zone": "{where} dead zone",
    "encoder_bias": "{where} offset",
    "encoder_scale": "{where} scale error",
    "friction_drift": "fading friction at {joint}",
    "goal_acceleration_limit": "{where} acceleration limit",
    "goal_resolution": "{where} resolution",
    "goal_speed_limit": "{where} speed limit",
    "hardening_spring": "hardening spring at {joint}",
    "input_delay": "{where} delay",
    "joint_elasticity": "elastic transmission at {joint}",
    "load_dependent_friction": "load-dependent friction at {joint}",
    "offset_payload": "additional payload off the centre of mass",
    "parameter_drift": "drift of {where}",
    "payload": "additional payload",
    "periodic_disturbance": "periodic force at {joint}",
    "presliding_friction": "bristle friction at {joint}",
    "quadratic_drag": "quadratic drag at {joint}",
    "quantisation": "{where} resolution",
    "saturation": "{where} limit",
    "sensor_delay": "{where} delay",
    "sensor_low_pass": "{where} low-pass",
    "servo_dead_band": "{where} dead band",
    "servo_force_limit": "{where} force limit",
    "servo_gain": "{where} servo gain error",
    "servo_integral_action": "{where} integral action",
    "spring": "spring at {joint}",
    "stribeck_friction": "Stribeck friction at {joint}",
    "supply_sag": "supply sag of {where}",
    "tilt": "tilted base",
    "unbalance": "unbalance at {joint}",
    "viscous_friction": "viscous friction at {joint}",
    "wind": "wind at {joint}",
}
"""Name of each effect of the catalogue; ``{where}`` is its port, ``{joint}`` the joint of a
force's port. An effect of a user's own is named by its id."""

MOST_PORTS = 2
"""Maximum number of channels of a group that are listed by name; of more, only the number."""

_FORCE = re.compile(r"_(torque|force)$")
_CHANNEL = re.compile(r"(?<![\w./-])[A-Za-z0-9]+(?:_[A-Za-z0-9]+)+(?![\w/(]|\.\w)")
"""A name with underscores that is no file, option or call."""

GROUPS = {"actuator": "commands", "input": "commands", "servo": "servos"}
"""What the members of a group are, by the first word of an effect's id."""

_SHARES = ("error", "skew")
"""Parameters that are relative errors; they are shown in per cent."""


def why_unnamed(effect: Mapping[str, Any]) -> str:
    """Returns in a few words why an effect of the revised model is not named; empty for others.

    Args:
        effect: The effect in ``discovery.json``.
    """
    if number_of_model := effect.get("corrects"):
        return f"corrects {number_of_model}"
    return "small" if effect.get("is_minor") else ""


def effect_title(effect: str, port: str) -> str:
    """Returns an effect's name in words.

    Args:
        effect: Its id, such as ``"sensor_low_pass"``.
        port: Its port, such as ``"arm_velocity,pole_velocity"``.
    """
    prefix = effect.partition("_")[0]
    where = _where(port, GROUPS.get(prefix, "channels"))
    joint = _where(_FORCE.sub("", port))
    title = TITLES.get(effect)
    if title is None:
        name = effect.replace("_", " ")
        return f"{name} at {where}" if where else name
    return title.format(where=where or "its", joint=joint or "its joint")


def effect_label(row: Mapping[str, Any]) -> str:
    """Returns an effect's name and its main quantity, such as ``"voltage delay, 12 ms"``.

    Args:
        row: An entry of ``effects`` in ``discovery.json``.
    """
    title = effect_title(str(row.get("effect", "effect")), str(row.get("port") or ""))
    parameters = row.get("parameters") or {}
    means = {name: p["mean"] for name, p in parameters.items() if _is_number(p.get("mean"))}
    if not means:
        return title
    first = next(iter(means))
    unit = str(parameters[first].get("unit", ""))
    if {"sine", "cosine"} <= means.keys():
        return f"{title}, {quantity(math.hypot(means['sine'], means['cosine']), unit)}"
    if {"roll", "pitch"} <= means.keys():
        return f"{title}, {quantity(math.hypot(means['roll'], means['pitch']), unit)}"
    return f"{title}, {quantity(means[first], unit, is_share=first in _SHARES)}"


def quantity(value: float, unit: str, *, is_share: bool = False) -> str:
    """Returns a number with its unit: times below a second in ms, angles in degrees.

    Args:
        value: The number in SI units.
        unit: Its unit; ``"1"`` for none.
        is_share: Whether it is a relative error, shown in per cent.
    """
    if is_share:
        return f"{number(100.0 * value, '.2g')} %"
    if unit == "s" and abs(value) < 1.0:
        return f"{number(1e3 * value, '.3g')} ms"
    if unit == "rad":
        return f"{number(math.degrees(value), '.3g')}°"
    return f"{number(value, '.3g')} {unit}" if unit not in ("", "1") else number(value, ".3g")


def in_words(text: str) -> str:
    """Returns a sentence with words in place of ``port.effect`` and ``joint_6_velocity``."""
    ids = "|".join(sorted(map(re.escape, TITLES), key=len, reverse=True))
    found = re.compile(rf"([\w,]+)\.({ids})\b")
    text = found.sub(lambda m: effect_title(m.group(2), m.group(1)), text)
    return _CHANNEL.sub(lambda m: m.group().replace("_", " "), text)


def cause_in_words(name: str) -> str:
    """Returns an entry of ``equivalent_to`` in words: an id, or the whole name of an effect."""
    return in_words(name).replace("_", " ")


def _where(port: str, group: str = "channels") -> str:
    """Returns a port in words; of a group, what its channels have in common.

    Args:
        port: The port.
        group: What the members of a group are.
    """
    channels = [channel.strip() for channel in port.split(",") if channel.strip()]
    words = [channel.split("_") for channel in channels]
    if len(channels) > 1:
        # "joint_6,joint_6_velocity" is joint 6, "arm_velocity,pole_velocity" is the velocity.
        shared = _shared(words) or _shared([w[::-1] for w in words])[::-1]
        if shared:
            return " ".join(shared)
        if len(channels) > MOST_PORTS:
            return _numbered(channels) or f"{len(channels)} {group}"
    return " and ".join(" ".join(w) for w in words)


def _numbered(channels: list[str]) -> str:
    """Returns e.g. ``"thrust 1 to 4"`` for names that only count; empty for others."""
    found = [re.fullmatch(r"(.*?)_?(\d+)", channel) for channel in channels]
    names = {match.group(1) for match in found if match is not None and match.group(1)}
    numbers = [int(match.group(2)) for match in found if match is not None]
    if len(names) != 1 or len(numbers) < len(channels):
        return ""
    if numbers != [*range(numbers[0], numbers[0] + len(numbers))]:
        return ""
    return f"{names.pop().replace('_', ' ')} {numbers[0]} to {numbers[-1]}"


def _shared(words: list[list[str]]) -> list[str]:
    """Returns the words with which all of several names begin."""
    shared = []
    for together in zip(*words, strict=False):
        if len(set(together)) > 1:
            break
        shared.append(together[0])
    # "joint_1,joint_2" have only the word joint in common, which says nothing.
    return shared if any(len(w) == len(shared) for w in words) or _is_quantity(shared) else []


def _is_quantity(words: list[str]) -> bool:
    return bool(words) and words[0] in ("velocity", "angle", "position", "speed", "torque")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
