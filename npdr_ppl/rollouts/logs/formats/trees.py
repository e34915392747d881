"""Makes signals of named arrays in groups, as HDF5 and MAT files hold them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.episodes import named_episodes
from npdr_ppl.rollouts.logs.formats.time_stamps import is_time_name, seconds_of
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.logs.log_settings import HOW_TO_NAME_TIME, LogSettings
from npdr_ppl.rollouts.logs.nearest_names import missing
from npdr_ppl.rollouts.notes import Remark

__all__ = ["Leaf", "log_of_tree"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Leaf:
    """An array of a tree.

    Attributes:
        values: Its numbers, with one or two dimensions.
        unit: Its unit, ``""`` if the file states none.
    """

    values: Array
    unit: str = ""


def log_of_tree(source: str, leaves: Mapping[str, Leaf], settings: LogSettings) -> Log:
    """Makes a log of arrays; each has the time stamps of the nearest group that fit its length.

    Args:
        source: Name of the file.
        leaves: Arrays by path, e.g. ``"arm/position"``: ``(N,)``, ``(N, C)`` or ``(C, N)``.
        settings: How to read the log.

    Raises:
        DataError: There is no time.
    """
    leaves = {name: Leaf(_flat(leaf.values), leaf.unit) for name, leaf in leaves.items()}
    if settings.time is not None and settings.time not in leaves:
        raise DataError(missing("data set", settings.time, leaves))
    notes: list[str] = []
    times: dict[str, Array] = {}
    for name, leaf in leaves.items():
        is_chosen = name == settings.time if settings.time else is_time_name(name)
        if is_chosen and leaf.values.ndim == 1 and len(leaf.values) > 1:
            times[name], note = seconds_of(name, leaf.values, settings)
            notes += [Remark(f"{note}.")] if note else []
    if not times and settings.time_step is None:
        raise DataError(
            f"none of its data sets looks like time stamps; they are called "
            f"{rollout_checks.shown(', '.join(leaves), 200)}; {HOW_TO_NAME_TIME}"
        )
    signals: list[Signal] = []
    skipped: list[str] = []
    for name, leaf in leaves.items():
        if name in times:
            continue
        found = _timed(name, leaf.values, times, settings)
        if found is None:
            skipped.append(name)
            continue
        time, columns = found
        for index in range(columns.shape[1]):
            values = columns[:, index].copy()
            values[np.isinf(values)] = np.nan
            component = f"{name}.{index}" if columns.shape[1] > 1 else name
            signals.append(Signal(component, time, values, leaf.unit))
        if len(signals) > LIMITS.columns:
            raise DataError(f"it has more than {LIMITS.columns} signals.")
    if skipped:
        told = rollout_checks.shown(", ".join(skipped), 200)
        notes.append(Remark(f"no time stamps fit the length of {told}; left out."))
    names = [signal.name for signal in signals]
    episodes = named_episodes(names, settings)
    return Log(source, tuple(signals), tuple(notes), episodes if episodes in names else "")


def _flat(values: Array) -> Array:
    """Returns a single row or column as a vector; MATLAB has no vectors."""
    return values.ravel() if values.ndim == 2 and 1 in values.shape else values


def _timed(
    name: str, values: Array, times: Mapping[str, Array], settings: LogSettings
) -> tuple[Array, Array] | None:
    """Returns time stamps in s ``(N,)`` and values ``(N, C)``; ``None`` if no stamps fit."""
    if values.ndim not in (1, 2) or values.size == 0:
        return None
    if not times:
        columns = values.reshape(len(values), -1)
        if len(columns) < 2 or columns.shape[1] > LIMITS.columns or settings.time_step is None:
            return None
        return np.arange(len(columns)) * np.float64(settings.time_step), columns
    parts = name.split("/")[:-1]
    for depth in range(len(parts), -1, -1):
        group = "/".join(parts[:depth])
        for other, time in times.items():
            is_near = other.rpartition("/")[0] == group or (depth == 0 and settings.time)
            if not is_near:
                continue
            if values.shape[0] == len(time):
                return time, values.reshape(len(time), -1)
            if values.ndim == 2 and values.shape[1] == len(time):
                return time, values.T
    return None
