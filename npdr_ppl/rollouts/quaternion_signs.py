"""Makes quaternions of a log continuous: q and −q are the same orientation.

An estimator may write either of them and change between two rows. A simulated quaternion does not
jump, so that no parameter explains a measured one that does.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.removed_jumps import joined, nearest_of, rewritten
from npdr_ppl.rollouts.sampling import Sampling

__all__ = ["continuous"]

AXES = "wxyz"

NORM = 0.1
"""Difference of a quaternion's norm from one up to which four channels are one."""

MOST = 0.9
"""Least share of the rows with such a norm; others are dropouts."""


def continuous(rollouts: Rollouts, channels: Sequence[Channel]) -> Rollouts:
    """Returns rollouts in which quaternions do not change their sign, with a remark about each.

    A quaternion has four channels whose names differ in their last letter, w, x, y and z. It
    changes its sign where the opposite of a measurement is closer to the one before.

    Args:
        rollouts: The recording.
        channels: The simulator's channels that were recorded.
    """
    names = {channel.name for channel in channels if channel.unit == "1"}
    for stem in sorted(name[:-1] for name in names if name.endswith("w")):
        if all(f"{stem}{axis}" in names for axis in AXES):
            rollouts = _quaternion_continuous(rollouts, stem)
    return rollouts


def _quaternion_continuous(rollouts: Rollouts, stem: str) -> Rollouts:
    """Returns rollouts in which one quaternion does not change its sign."""
    columns = [rollouts.channel_names.index(f"{stem}{axis}") for axis in AXES]
    made, total = [], 0
    for index, readings in enumerate(rollouts.readings):
        readings, sampling, number = _without_flips(readings, rollouts.sampling(index), columns)
        made.append((readings, sampling))
        total += number
    if not total:
        return rollouts
    rows = "row" if total == 1 else "rows"
    remark = Remark(
        f"The quaternion {stem}w … {stem}z changes its sign at {total} {rows}, which is the same "
        "orientation; its signs were made continuous."
    )
    return rewritten(rollouts, made, remark)


def _without_flips(
    readings: Array, sampling: Sampling, columns: Sequence[int]
) -> tuple[Array, Sampling, int]:
    """Returns readings and measurements of a rollout without changes of sign, and their number."""
    rows = np.flatnonzero(sampling.is_read[:, columns].all(1))
    is_unit = np.abs(np.linalg.norm(sampling.values[rows][:, columns], axis=1) - 1.0) < NORM
    if len(rows) < 2 or is_unit.mean() < MOST:
        return readings, sampling, 0
    rows = rows[is_unit]
    measured = sampling.values[rows][:, columns]
    is_flip = (measured[1:] * measured[:-1]).sum(1) < 0.0
    if not is_flip.any():
        return readings, sampling, 0
    signs = np.concatenate(([1.0], np.where(is_flip, -1.0, 1.0).cumprod()))
    changed, values = np.array(readings), np.array(sampling.values)
    for column, own in zip(columns, (signs[:, None] * measured).T, strict=True):
        place = rows + sampling.lateness[rows, column]
        at_rows = readings[:, column] * signs[nearest_of(place, len(readings))]
        changed[:, column] = values[:, column] = joined(at_rows, place, own, is_flip)
        values[rows, column] = own
    return changed, replace(sampling, values=values), int(is_flip.sum())
