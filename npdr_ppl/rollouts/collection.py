"""Rollouts as a collection: stack, pick, join, compare, and summarise in a line."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel, Follower, Spin
from npdr_ppl.rollouts import segments
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.sampling import Sampling

__all__ = [
    "are_equal",
    "checksum",
    "joined",
    "picked",
    "pieces",
    "shortened",
    "stacked",
    "summary",
    "with_channels",
    "with_commands",
    "with_followers",
    "without_duplicates",
]

Episodes = TypeVar("Episodes", bound=Recording)

OPTIONAL = ("rewards", "samplings", "stretches")
"""Fields with one entry per rollout, or none at all."""

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
    fields = ["readings", "actions", "time"]
    fields += [name for name in OPTIONAL if getattr(rollouts, name)]
    return replace(
        rollouts, **{name: tuple(getattr(rollouts, name)[i] for i in chosen) for name in fields}
    )


def pieces(rollouts: Episodes) -> Episodes:
    """Returns rollouts of which each is one usable stretch of the given ones."""
    if rollouts.is_whole:
        return rollouts
    stretches = [(r, a, b) for r, spans in enumerate(rollouts.spans) for a, b in spans]
    rewards, samplings = rollouts.rewards, rollouts.samplings
    return replace(
        rollouts,
        readings=tuple(rollouts.readings[r][a : b + 1] for r, a, b in stretches),
        actions=tuple(rollouts.actions[r][a:b] for r, a, b in stretches),
        time=tuple(rollouts.time[r][a : b + 1] for r, a, b in stretches),
        rewards=rewards and tuple(rewards[r][a:b] for r, a, b in stretches),
        samplings=samplings and tuple(samplings[r].rows(a, b + 1) for r, a, b in stretches),
        stretches=(),
    )


def shortened(rollouts: Episodes, num_steps: int) -> Episodes:
    """Returns rollouts without the steps after the first ones.

    Args:
        rollouts: The rollouts.
        num_steps: Most steps of each rollout that are kept.
    """
    return replace(
        rollouts,
        readings=tuple(values[: num_steps + 1] for values in rollouts.readings),
        actions=tuple(values[:num_steps] for values in rollouts.actions),
        time=tuple(values[: num_steps + 1] for values in rollouts.time),
        rewards=rollouts.rewards and tuple(values[:num_steps] for values in rollouts.rewards),
        samplings=tuple(sampling.rows(0, num_steps + 1) for sampling in rollouts.samplings),
        stretches=tuple(
            tuple((first, min(end, num_steps)) for first, end in spans if first < num_steps)
            for spans in rollouts.spans
        ),
    )


def with_channels(rollouts: Episodes, channels: Sequence[str]) -> Episodes:
    """Returns the rollouts with only these channels, in this order."""
    columns = segments.columns_of(channels, rollouts.channel_names)
    return replace(
        rollouts,
        readings=tuple(values[:, columns] for values in rollouts.readings),
        channel_names=tuple(channels),
        channel_units=tuple(rollouts.channel_units[i] for i in columns),
        samplings=tuple(sampling.channels(columns) for sampling in rollouts.samplings),
    )


def with_commands(rollouts: Episodes, actions: Sequence[Channel]) -> Episodes:
    """Returns rollouts with all actions of a simulator among their actions.

    If none was recorded, the motion was free, and all commands are zero. An action that was read
    as a measurement becomes an action.

    Args:
        rollouts: The rollouts.
        actions: The simulator's actions.
    """
    missing = [action for action in actions if action.name not in rollouts.action_names]
    if not missing:
        return rollouts
    as_channels = [a.name for a in missing if a.name in rollouts.channel_names]
    if not as_channels and not rollouts.action_names:
        names = ", ".join(action.name for action in actions)
        return replace(
            rollouts,
            actions=tuple(np.zeros((length, len(actions))) for length in rollouts.lengths),
            action_names=tuple(action.name for action in actions),
            action_units=tuple(action.unit for action in actions),
            notes=(*rollouts.notes, f"No commands were recorded; zero is assumed for {names}."),
        )
    if not as_channels or len(as_channels) == len(rollouts.channel_names):
        return rollouts
    columns = segments.columns_of(as_channels, rollouts.channel_names)
    left = [name for name in rollouts.channel_names if name not in as_channels]
    names = ", ".join(as_channels)
    return replace(
        with_channels(rollouts, left),
        notes=(*rollouts.notes, f"Recorded as measurements, but used as commands: {names}."),
        actions=tuple(
            np.concatenate((commands, readings[:-1, columns]), axis=1)
            for commands, readings in zip(rollouts.actions, rollouts.readings, strict=True)
        ),
        action_names=(*rollouts.action_names, *as_channels),
        action_units=(*rollouts.action_units, *(rollouts.channel_units[i] for i in columns)),
    )


def with_followers(rollouts: Episodes, followers: Sequence[Follower | Spin]) -> Episodes:
    """Returns rollouts with the states that follow from recorded ones, not as measurements.

    They say where a simulation begins, but it is not compared with them.

    Args:
        rollouts: The rollouts.
        followers: States that follow from others.
    """
    while True:
        names = rollouts.channel_names
        new = [f for f in followers if f.name not in names and set(f.leaders) <= set(names)]
        if not new:
            return rollouts
        follower = new[0]
        columns = [names.index(leader) for leader in follower.leaders]
        values = [
            follower.follow(readings[:, columns], rollouts.time_step)[:, None]
            for readings in rollouts.readings
        ]
        samplings = rollouts.samplings or [Sampling.at_rows(r) for r in rollouts.readings]
        rollouts = replace(
            rollouts,
            readings=tuple(map(np.hstack, zip(rollouts.readings, values, strict=True))),
            channel_names=(*names, follower.name),
            channel_units=(
                *rollouts.channel_units,
                follower.unit or rollouts.channel_units[columns[0]],
            ),
            samplings=tuple(
                sampling.with_unread(added)
                for sampling, added in zip(samplings, values, strict=True)
            ),
            notes=(
                *rollouts.notes,
                f"{follower.name} was not recorded: it follows from "
                f"{', '.join(follower.leaders)}.",
            ),
        )


def without_duplicates(rollouts: Episodes) -> Episodes:
    """Returns rollouts of which those that are identical to an earlier one are not used."""
    seen: dict[bytes, int] = {}
    spans, notes = list(rollouts.spans), []
    for index, (readings, actions) in enumerate(
        zip(rollouts.readings, rollouts.actions, strict=True)
    ):
        digest = hashlib.sha256(readings.tobytes())
        digest.update(actions.tobytes())
        first = seen.setdefault(digest.digest(), index)
        if first != index and spans[index]:
            spans[index] = ()
            notes.append(f"Rollout {index} is identical to rollout {first}; left out.")
    if not notes:
        return rollouts
    return replace(rollouts, stretches=tuple(spans), notes=(*rollouts.notes, *notes))


def checksum(rollouts: Recording) -> str:
    """Returns a SHA-256 of all that rollouts hold, as hexadecimal digits."""
    digest = hashlib.sha256(repr((rollouts.channel_names, rollouts.time_step)).encode())
    for readings, actions in zip(rollouts.readings, rollouts.actions, strict=True):
        digest.update(readings.tobytes())
        digest.update(actions.tobytes())
    digest.update(repr(rollouts.spans).encode())
    for sampling in rollouts.samplings:
        for part in (sampling.values, sampling.lateness, sampling.is_read):
            digest.update(part.tobytes())
    return digest.hexdigest()


def are_equal(one: Recording, other: Recording) -> bool:
    """Returns whether two sets of rollouts have the same columns and the same values."""
    return (
        all(getattr(one, field) == getattr(other, field) for field in COLUMNS)
        and one.time_step == other.time_step
        and one.lengths == other.lengths
        and one.spans == other.spans
        and (one.rewards is None) == (other.rewards is None)
        and len(one.samplings) == len(other.samplings)
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
        and all(
            np.array_equal(getattr(a, part), getattr(b, part))
            for a, b in zip(one.samplings, other.samplings, strict=True)
            for part in ("values", "lateness", "is_read")
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
    if any(part.samplings for part in parts):
        parts = [
            replace(part, samplings=tuple(map(part.sampling, range(len(part))))) for part in parts
        ]
    fields = ["readings", "actions", "time"]
    fields += [name for name in ("rewards", "samplings") if getattr(parts[0], name)]
    return replace(
        first,
        **{name: tuple(v for part in parts for v in getattr(part, name)) for name in fields},
        stretches=tuple(spans for part in parts for spans in part.spans),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
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
