"""Finds the column of a table whose every change begins a new episode."""

from collections.abc import Mapping

import numpy as np

from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.clock_jumps import restarts
from npdr_ppl.rollouts.logs.log_settings import LogSettings
from npdr_ppl.rollouts.logs.signal_names import role_of
from npdr_ppl.rollouts.notes import Remark

__all__ = ["continued", "episodes_in", "named_episodes"]

EPISODE_NAMES = ("episode_index", "episode", "rollout")
"""Columns whose every change begins a new episode, unless the mapping names another one."""


def named_episodes(names: Mapping[str, object], settings: LogSettings) -> str:
    """Returns the signal that the mapping names, or one with a usual name; ``""`` if none.

    Args:
        names: The signals by name.
        settings: They may name the signal, or say with ``""`` that there is none.
    """
    if settings.episodes is not None:
        return settings.episodes
    return next((name for name in EPISODE_NAMES if name in names), "")


def episodes_in(
    time: Array, columns: Mapping[str, Array], settings: LogSettings
) -> tuple[str, Remark | None]:
    """Returns the column that marks episodes, and a remark if only the time tells.

    Without a named column, it is one that counts up wherever the clock was restarted, and only
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
    if named or settings.episodes is not None:
        return named, None
    if not len(restarts(time)):
        return "", None
    for name, values in columns.items():
        known = np.isfinite(time) & np.isfinite(values)
        counts = values[known]
        (ups,), (changes,) = (
            np.nonzero(counts[1:] > counts[:-1]),
            np.nonzero(counts[1:] != counts[:-1]),
        )
        begins = restarts(time[known])
        is_counter = np.array_equal(ups, changes) and bool((counts == np.round(counts)).all())
        if (
            is_counter
            and len(begins)
            and np.array_equal(ups + 1, begins)
            and role_of(name) == "other"
        ):
            told = rollout_checks.shown(name)
            return name, Remark(
                f"the time begins anew with each {told}, so each is a rollout; if not, set "
                'episodes = "" below [log] in the mapping.'
            )
    return "", None


def continued(time: Array, episodes: Array) -> Array:
    """Returns time stamps that go on from episode to episode, where each began anew.

    Args:
        time: Time stamps in s, ``(N,)``.
        episodes: Number of the episode of each row, ``(N,)``.
    """
    begins = np.flatnonzero(np.diff(episodes) != 0) + 1
    if not len(begins) or not (np.diff(time)[begins - 1] <= 0).any():
        return time
    steps = np.diff(time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    jumps = np.zeros(len(time))
    jumps[begins] = np.where(steps[begins - 1] <= 0, usual - steps[begins - 1], 0.0)
    return time + np.cumsum(jumps)
