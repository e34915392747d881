"""Adds up whole turns of angles that a log wraps, e.g. headings between −π and π.

A simulated angle counts on when the device turns. A wrapped measurement of it jumps by a whole
turn, which no parameter explains.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.sampling import Sampling

__all__ = ["unwrapped"]

TURNS = {2.0 * math.pi: "rad", 360.0: "degrees"}
"""A whole turn, and its unit. A log may be in degrees without saying so."""

ROUNDING = 1e-3
"""By which share of a turn the range of a wrapped angle may exceed it, e.g. by rounding."""

USUAL = 0.99
"""Share of the other changes between measurements that are at most as large as a usual one."""

SMOOTH = 2.0
"""Change across a jump, a whole turn subtracted, up to which the motion goes on across it, in
usual changes."""

INTERPOLATED_NEARBY = 3
"""Number of measurements on either side of a jump around which readings are interpolated anew: a
reading between measurements depends on three of them on either side."""


def unwrapped(rollouts: Rollouts, channels: Sequence[Channel]) -> Rollouts:
    """Returns rollouts in which wrapped angles count on, with a remark about each.

    An angle is wrapped if all its values lie within a turn, if it changes by more than half a turn
    between two measurements, and if most of these changes are smooth once a turn is subtracted.
    Other changes must be below a quarter of a turn; of faster motion or of noise the turns cannot
    be told. A channel is left as it is if its declared bounds are within a turn: the simulator
    wraps it, too.

    Args:
        rollouts: The recording.
        channels: The simulator's channels that were recorded.
    """
    for channel in channels:
        if channel.unit == "rad" and not channel.upper - channel.lower <= 2.0 * math.pi:
            rollouts = _channel_unwrapped(rollouts, channel.name)
    return rollouts


def _channel_unwrapped(rollouts: Rollouts, name: str) -> Rollouts:
    """Returns rollouts in which one angle counts on, if it is wrapped."""
    column = rollouts.channel_names.index(name)
    samplings = [rollouts.sampling(index) for index in range(len(rollouts))]
    series = [s.values[s.is_read[:, column], column] for s in samplings]
    turn = next((turn for turn in TURNS if _is_wrapped(series, turn)), None)
    if turn is None:
        return rollouts
    made = [
        _counting_on(readings, sampling, column, turn)
        for readings, sampling in zip(rollouts.readings, samplings, strict=True)
    ]
    low, high = (f(np.concatenate(series)) for f in (np.min, np.max))
    remark = Remark(
        f"{name} stays between {low:.4g} and {high:.4g} {TURNS[turn]} and jumps by whole turns; "
        "the turns are added up, so that it counts on."
    )
    return replace(
        rollouts,
        readings=tuple(readings for readings, _ in made),
        samplings=tuple(sampling for _, sampling in made) if rollouts.samplings else (),
        notes=(*rollouts.notes, remark),
    )


def _is_wrapped(series: Sequence[Array], turn: float) -> bool:
    """Returns whether measurements of all rollouts are a wrapped angle."""
    values = np.concatenate(series) if series else np.zeros(0)
    if not len(values) or np.ptp(values) > (1.0 + ROUNDING) * turn:
        return False
    changes = np.concatenate([np.diff(own) for own in series])
    is_jump = np.abs(changes) > 0.5 * turn
    if not is_jump.any() or is_jump.all():
        return False
    left = np.abs(changes[is_jump] - turn * np.sign(changes[is_jump]))
    usual = float(np.quantile(np.abs(changes[~is_jump]), USUAL))
    return usual < 0.25 * turn and bool(np.mean(left <= SMOOTH * usual) > 0.5)


def _counting_on(
    readings: Array, sampling: Sampling, column: int, turn: float
) -> tuple[Array, Sampling]:
    """Returns readings and measurements of a rollout, with an angle's turns added up."""
    rows = np.flatnonzero(sampling.is_read[:, column])
    if len(rows) < 2:
        return readings, sampling
    measured, place = sampling.values[rows, column], rows + sampling.lateness[rows, column]
    whole = np.unwrap(measured, period=turn)
    every = np.arange(len(readings))
    # Between measurements, the number of turns is that of the nearest one.
    nearest = np.searchsorted(0.5 * (place[1:] + place[:-1]), every)
    at_rows = readings[:, column] + (whole - measured)[nearest]
    jumps = np.flatnonzero(np.abs(np.diff(measured)) > 0.5 * turn)
    is_near = (np.abs(nearest[:, None] - jumps - 0.5) <= INTERPOLATED_NEARBY).any(1)
    at_rows[is_near] = np.interp(every[is_near], place, whole)
    changed, values = np.array(readings), np.array(sampling.values)
    changed[:, column] = values[:, column] = at_rows
    values[rows, column] = whole
    return changed, replace(sampling, values=values)
