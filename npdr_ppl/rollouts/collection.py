"""Rollouts as a collection: stack, pick, join, compare, and summarise in a line."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import segments
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.recording import Recording

__all__ = ["are_equal", "joined", "picked", "stacked", "summary", "with_channels"]

Episodes = TypeVar("Episodes", bound=Recording)

COLUMNS = ("channel_names", "action_names", "channel_units", "action_units")
"""Fields that describe the columns."""


def stacked(rollouts: Recording) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Returns measurements, actions and mask of all rollouts; see :meth:`Rollouts.stacked`."""
    longest, num = max(rollouts.lengths), len(rollouts)
    readings = np.zeros((num, longest + 1, len(rollouts.channel_names)))
    actions = np.zeros((num, longest, len(rollouts.action_names)))
    mask = np.zeros((num, longest), dtype=bool)
    for index, length in enumerate(rollouts.lengths):
        readings[index, : length + 1] = rollouts.readings[index]
        actions[index, :length] = rollouts.actions[index]
        mask[index, :length] = True
    return readings, actions, mask


def picked(rollouts: Episodes, chosen: Sequence[int]) -> Episodes:
    """Returns the rollouts of these indices, in this order."""
    rewards = rollouts.rewards
    return replace(
        rollouts,
        readings=tuple(rollouts.readings[i] for i in chosen),
        actions=tuple(rollouts.actions[i] for i in chosen),
        time=tuple(rollouts.time[i] for i in chosen),
        rewards=None if rewards is None else tuple(rewards[i] for i in chosen),
    )


def with_channels(rollouts: Episodes, channels: Sequence[str]) -> Episodes:
    """Returns the rollouts with only these channels, in this order."""
    columns = segments.columns_of(channels, rollouts.channel_names)
    return replace(
        rollouts,
        readings=tuple(values[:, columns] for values in rollouts.readings),
        channel_names=tuple(channels),
        channel_units=tuple(rollouts.channel_units[i] for i in columns),
    )


def are_equal(one: Recording, other: Recording) -> bool:
    """Returns whether two sets of rollouts have the same columns and the same values."""
    return (
        all(getattr(one, field) == getattr(other, field) for field in COLUMNS)
        and one.time_step == other.time_step
        and one.lengths == other.lengths
        and (one.rewards is None) == (other.rewards is None)
        and all(
            np.array_equal(a, b)
            for left, right in (
                (one.readings, other.readings),
                (one.actions, other.actions),
                (one.time, other.time),
                (one.rewards or (), other.rewards or ()),
            )
            for a, b in zip(left, right, strict=True)
        )
    )


def joined(parts: Sequence[Episodes]) -> Episodes:
    """Returns the rollouts of several sets, one set after the other.

    Args:
        parts: Sets with the same columns and time step, at least one.

    Raises:
        DataError: Columns or time steps differ.
    """
    first = parts[0]
    for other in parts[1:]:
        for field in COLUMNS:
            if getattr(first, field) != getattr(other, field):
                raise DataError(
                    f"{field} differ: {', '.join(getattr(first, field))} and "
                    f"{', '.join(getattr(other, field))}."
                )
        if not math.isclose(first.time_step, other.time_step, rel_tol=1e-6):
            raise DataError(f"time steps differ: {first.time_step} and {other.time_step} s.")
        if (first.rewards is None) != (other.rewards is None):
            raise DataError("some of the rollouts have rewards and some have not.")
    rewards = None
    if first.rewards is not None:
        rewards = tuple(values for part in parts for values in part.rewards or ())
    return replace(
        first,
        readings=tuple(values for part in parts for values in part.readings),
        actions=tuple(values for part in parts for values in part.actions),
        time=tuple(values for part in parts for values in part.time),
        rewards=rewards,
    )


def summary(rollouts: Recording) -> str:
    """Returns number of rollouts, lengths, time step and columns in one line."""
    low, high = min(rollouts.lengths), max(rollouts.lengths)
    steps = f"{low}" if low == high else f"{low}–{high}"
    return (
        f"Rollouts({len(rollouts)} × {steps} steps of {rollouts.time_step:.6g} s; "
        f"channels {_listed(rollouts.channel_names, rollouts.channel_units)}; "
        f"actions {_listed(rollouts.action_names, rollouts.action_units)}"
        f"{'' if rollouts.rewards is None else '; rewards'})"
    )


def _listed(names: Sequence[str], units: Sequence[str]) -> str:
    entries = (f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True))
    return ", ".join(entries) or "none"
