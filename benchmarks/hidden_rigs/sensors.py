"""What sensors make of the true motion, before noise: timing, filters, scale and offset."""

from collections.abc import Sequence

import numpy as np

from hidden_rigs.hidden import Hidden
from hidden_rigs.mechanics import Array
from hidden_rigs.plant import Layout

__all__ = ["SENSOR_LAWS", "sensed"]

SENSOR_LAWS = (
    "sensor_delay",
    "clock_skew",
    "sensor_low_pass",
    "encoder_scale",
    "encoder_bias",
    "eccentric_encoder",
)
"""Ids of the effects on readings; the last is in no catalogue."""


def sensed(
    motion: Array,
    substep: float,
    begin: int,
    num_substeps: int,
    num_steps: int,
    hidden: Sequence[Hidden],
    layout: Layout,
) -> Array:
    """Returns what noise-free sensors report, ``(R, num_steps + 1, channels)``.

    Delays and skewed clocks look the motion up at other times, between substeps along a line. A
    filter runs on the substeps, and has run before the recording began.

    Args:
        motion: True positions and velocities at all substeps, ``(N, channels, R)``, some of it
            before the recording begins and some after it ends.
        substep: Seconds between them.
        begin: Substep at which the recording begins.
        num_substeps: Substeps per sample.
        num_steps: Steps of the recording.
        hidden: What is hidden.
        layout: Names of the channels.
    """
    samples = np.arange(num_steps + 1, dtype=np.float64)
    result = []
    for column, channel in enumerate(layout.sensors):
        mine = [
            h
            for h in hidden
            if h.effect_id in SENSOR_LAWS
            and (h.effect_id == "clock_skew" or channel in h.port.split(","))
        ]
        at = samples * num_substeps  # in substeps since the recording began
        for h in mine:
            if h.effect_id == "sensor_delay":
                at = at - h.parameters["delay"] / substep
            elif h.effect_id == "clock_skew":
                at = at * (1.0 + h.parameters["skew"])
        values = motion[:, column]
        for h in mine:
            if h.effect_id == "sensor_low_pass":
                values = _filtered(values, h.parameters["time_constant"], substep)
        values = _looked_up(values, at + begin)
        for h in mine:
            values = _changed(values, h)
        result.append(values)
    return np.stack(result, axis=-1).swapaxes(0, 1)


def _looked_up(table: Array, at: Array) -> Array:
    """Returns rows of a table ``(N, R)`` at places that need not be whole."""
    at = np.clip(at, 0.0, len(table) - 1.0)
    low = np.minimum(at.astype(np.int64), len(table) - 2)
    share = (at - low)[:, None]
    return (1.0 - share) * table[low] + share * table[low + 1]


def _filtered(values: Array, time_constant: float, substep: float) -> Array:
    """Returns values at substeps ``(N, R)`` after a low-pass, by the trapezoidal rule."""
    ratio = 0.5 * substep / time_constant
    filtered = values.copy()
    for k in range(1, len(values)):
        drive = ratio * (values[k - 1] + values[k] - filtered[k - 1])
        filtered[k] = (filtered[k - 1] + drive) / (1.0 + ratio)
    return filtered


def _changed(values: Array, hidden: Hidden) -> Array:
    """Returns samples ``(K, R)`` after a scale or an offset."""
    p = hidden.parameters
    if hidden.effect_id == "encoder_scale":
        return values + p["error"] * values
    if hidden.effect_id == "encoder_bias":
        return values + p["offset"]
    if hidden.effect_id == "eccentric_encoder":
        return values + p["amplitude"] * np.sin(values + p["phase"])
    return values
