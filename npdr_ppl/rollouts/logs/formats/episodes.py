"""Finds the column of a table whose every change begins a new episode."""

from collections.abc import Collection, Mapping

import numpy as np

from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.clock_jumps import restarts
from npdr_ppl.rollouts.logs.log_settings import LogSettings
from npdr_ppl.rollouts.logs.signal_names import role_of
from npdr_ppl.rollouts.notes import Remark

__all__ = ["episodes_in", "named_episodes", "shift_of_episodes"]

EPISODE_NAMES = ("episode_index", "episode", "rollout")
"""Columns whose every change begins a new episode, unless the mapping names another one."""


def named_episodes(names: Collection[str], settings: LogSettings) -> str:
    """Returns the signal that the mapping names, or one with a usual name; ``""`` if none.

    Args:
        names: Names of the signals.
        settings: They may name the signal, or say with ``""`` that there is none.
    """
    if settings.episodes is not None:
        return settings.episodes
    return next((name for name in EPISODE_NAMES if name in names), "")


def episodes_in(
    time: Array, columns: Mapping[str, Array], settings: LogSettings
) -> tuple[str, Remark | None]:
    """Returns the column that marks episodes, and a remark if only the time tells.

    Without a named column, it is one that increases wherever the clock was restarted, and only
    there. Its name must not tell that it is a command or a measurement, such as the height of a
    step that each episode applies.

    Args:
        time: Time stamps in s, ``(N,)``.
        columns: The columns, ``(N,)`` each.
        settings: They may name the column, or say with ``""`` that there is none.

    Returns:
        Its name, ``""`` if there is none, and the remark.
    """
    named = named_episodes(columns, settings)
    num = len(restarts(time))
    if named or settings.episodes is not None or not num:
        return named, None
    for name, values in columns.items():
        known = np.isfinite(time) & np.isfinite(values)
        counts = values[known]
        if role_of(name) != "other" or not (counts == np.round(counts)).all():
            continue
        changes = np.flatnonzero(counts[1:] != counts[:-1]) + 1
        is_rising = bool((counts[changes] > counts[changes - 1]).all())
        if len(changes) == num and is_rising and np.array_equal(changes, restarts(time[known])):
            told = rollout_checks.shown(name)
            return name, Remark(
                f"the time begins anew whenever {told} increases, so each value of it is a "
                'rollout; for one rollout, set episodes = "" below [log] in the mapping.'
            )
    return "", None


def shift_of_episodes(time: Array, episodes: Array) -> Array:
    """Returns what to add to time stamps so that they go on where an episode began anew, ``(N,)``.

    Args:
        time: Time stamps in s, ``(N,)``.
        episodes: Number of the episode of each row, ``(N,)``.
    """
    begins = np.flatnonzero(np.diff(episodes) != 0) + 1
    jumps, steps = np.zeros(len(time)), np.diff(time)
    if len(begins) and (steps[begins - 1] <= 0).any():
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
        jumps[begins] = np.where(steps[begins - 1] <= 0, usual - steps[begins - 1], 0.0)
    return np.cumsum(jumps)
