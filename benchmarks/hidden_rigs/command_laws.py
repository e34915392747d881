"""Laws that change a command before it reaches the drive, one substep at a time."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from hidden_rigs.mechanics import Array

__all__ = ["COMMAND_LAWS", "CommandLaw"]

Values = Mapping[str, float]

CommandLaw = Callable[[Array, Array], Array]
"""Maps the mean command of a substep and the position of the first joint, ``(R,)`` each, to what
comes out; it may remember what it was given before."""


def _delay(p: Values, substep: float) -> CommandLaw:
    """Late by a time that is no multiple of anything: what straddles a substep is shared out."""
    whole, fraction = divmod(p["delay"] / substep, 1.0)
    line: list[Array] = []

    def law(command: Array, position: Array) -> Array:
        if not line:
            line.extend([np.zeros_like(command)] * (int(whole) + 1))
        line.append(command)
        older, newer = line.pop(0), line[0]
        return fraction * older + (1.0 - fraction) * newer

    return law


def _lag(p: Values, substep: float) -> CommandLaw:
    """A first-order lag, exact for a command that is constant over the substep."""
    ratio = substep / p["time_constant"]
    decay = math.exp(-ratio)
    output: list[Array] = []

    def law(command: Array, position: Array) -> Array:
        before = output.pop() if output else np.zeros_like(command)
        output.append(command + decay * (before - command))
        return command + (before - output[0]) / ratio  # the mean over the substep

    return law


def _gain(p: Values, substep: float) -> CommandLaw:
    return lambda command, position: command + p["error"] * command


def _sag(p: Values, substep: float) -> CommandLaw:
    return lambda command, position: command - np.copysign(p["sag"] * command**2, command)


def _saturation(p: Values, substep: float) -> CommandLaw:
    limit = p["limit"]
    return lambda command, position: np.minimum(np.maximum(command, -limit), limit)


def _dead_zone(p: Values, substep: float) -> CommandLaw:
    def law(command: Array, position: Array) -> Array:
        rest = np.abs(command) - p["width"]
        return np.where(rest > 0.0, np.copysign(rest, command), 0.0)

    return law


def _position_dependent_gain(p: Values, substep: float) -> CommandLaw:
    """A motor that is stronger in some positions than in others; in no catalogue."""
    return lambda command, position: (
        command * (1.0 + p["depth"] * np.sin(p["wave_number"] * position))
    )


def _asymmetric_gain(p: Values, substep: float) -> CommandLaw:
    """An amplifier with another gain forwards than backwards; in no catalogue."""
    return lambda command, position: command + p["difference"] * np.abs(command)


COMMAND_LAWS: dict[str, Callable[[Values, float], CommandLaw]] = {
    "input_delay": _delay,
    "actuator_lag": _lag,
    "actuator_gain": _gain,
    "supply_sag": _sag,
    "saturation": _saturation,
    "dead_zone": _dead_zone,
    "position_dependent_gain": _position_dependent_gain,
    "asymmetric_gain": _asymmetric_gain,
}
"""Laws by the effect's id, made of the parameters and the seconds of a substep."""
