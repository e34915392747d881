"""Adds up whole turns of angles that a log wraps, e.g. headings between −π and π.

A simulated angle continues beyond π when the device turns. A wrapped measurement of it jumps by a
whole turn, which no parameter explains.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.removed_jumps import joined, nearest_of, rewritten
from npdr_ppl.rollouts.sampling import Sampling

__all__ = ["unwrapped"]

TURNS = ((2.0 * math.pi, "rad"), (360.0, "degrees"))
"""A whole turn in each unit. A log may be in degrees without saying so."""

BEYOND = 0.05
"""By which share of a turn the range of a wrapped angle may exceed it, because of noise that was
added later."""

NEARBY = 5
"""Number of changes before, and after, a jump that tell how fast the device moves."""

SMOOTH = 2.0
"""Change across a jump, a whole turn subtracted, up to which the motion goes on across it, in the
largest change nearby."""


def unwrapped(rollouts: Rollouts, channels: Sequence[Channel]) -> Rollouts:
    """Returns rollouts in which wrapped angles continue beyond a turn, with a remark about each.

    An angle is wrapped if all its values lie within a turn, if it jumps by more than half a turn
    between two measurements, and if most jumps are no larger than the changes nearby once a turn
    is subtracted. Nearby changes must be below a quarter of a turn; the turns of faster motion
    cannot be told. A channel is left as it is if its declared bounds are within a turn: the
    simulator wraps it, too.

    Args:
        rollouts: The recording.
        channels: The simulator's channels that were recorded.
    """
    for channel in channels:
        if channel.unit == "rad" and not channel.upper - channel.lower <= 2.0 * math.pi:
            rollouts = _channel_unwrapped(rollouts, channel.name)
    return rollouts


def _channel_unwrapped(rollouts: Rollouts, name: str) -> Rollouts:
    """Returns rollouts with the turns of one angle added up, if it is wrapped."""
    column = rollouts.channel_names.index(name)
    samplings = [rollouts.sampling(index) for index in range(len(rollouts))]
    series = [s.values[s.is_read[:, column], column] for s in samplings]
    turn, unit = next(((t, u) for t, u in TURNS if _is_wrapped(series, t)), (0.0, ""))
    if not turn:
        return rollouts
    made = [
        _with_turns_added(readings, sampling, column, turn)
        for readings, sampling in zip(rollouts.readings, samplings, strict=True)
    ]
    low, high = (f(np.concatenate(series)) for f in (np.min, np.max))
    remark = Remark(
        f"{name} stays between {low:.4g} and {high:.4g} {unit} and jumps by whole turns, which "
        "are added up."
    )
    return rewritten(rollouts, made, remark)


def _is_wrapped(series: Sequence[Array], turn: float) -> bool:
    """Returns whether measurements of all rollouts are a wrapped angle."""
    values = np.concatenate(series) if series else np.zeros(0)
    if not len(values) or np.ptp(values) > (1.0 + BEYOND) * turn:
        return False
    smooth = np.concatenate([_are_smooth(np.diff(own), turn) for own in series])
    return len(smooth) > 0 and bool(smooth.mean() > 0.5)


def _are_smooth(changes: Array, turn: float) -> NDArray[np.bool_]:
    """Returns for each jump among changes whether it is smooth once a turn is subtracted."""
    jumps = np.flatnonzero(np.abs(changes) > 0.5 * turn)
    left = np.abs(changes[jumps] - turn * np.sign(changes[jumps]))
    others = np.abs(changes)
    others[jumps] = 0.0
    padded = np.pad(others, NEARBY)
    # Row j holds the changes around jump j.
    largest = padded[jumps[:, None] + np.arange(2 * NEARBY + 1)].max(1, initial=0.0)
    return (largest < 0.25 * turn) & (left <= SMOOTH * largest)


def _with_turns_added(
    readings: Array, sampling: Sampling, column: int, turn: float
) -> tuple[Array, Sampling]:
    """Returns readings and measurements of a rollout, with an angle's turns added up."""
    rows = np.flatnonzero(sampling.is_read[:, column])
    if len(rows) < 2:
        return readings, sampling
    measured, place = sampling.values[rows, column], rows + sampling.lateness[rows, column]
    whole = np.unwrap(measured, period=turn)
    nearest = nearest_of(place, len(readings))
    # Between measurements, the number of turns is that of the nearest one.
    at_rows = readings[:, column] + (whole - measured)[nearest]
    is_jump = np.abs(np.diff(measured)) > 0.5 * turn
    at_rows = joined(at_rows, place, whole, is_jump)
    changed, values = np.array(readings), np.array(sampling.values)
    changed[:, column] = values[:, column] = at_rows
    values[rows, column] = whole
    return changed, replace(sampling, values=values)
