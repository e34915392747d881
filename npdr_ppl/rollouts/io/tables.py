"""The table layout of CSV and Parquet: one row per sample, rollouts one after another."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.gridding import recording_of, tracks_of
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.tracks import Track, stamp_notes, without_restarts

__all__ = ["from_table", "to_table"]

Array = NDArray[np.float64]

READ_AS_LOG = "; to read another layout, run npdr inspect FILE --write mapping.toml"
"""End of the message about a table that has other columns than ours: what to do."""


def from_table(
    columns: Mapping[str, Array],
    actions: Sequence[str] | None,
    *,
    lines: Sequence[int] | None = None,
    units: Mapping[str, str] | None = None,
) -> Recording:
    """Splits a table into rollouts.

    Args:
        columns: Values by name, ``(N,)`` each, NaN where a cell is empty.
        actions: Names of the action columns; if ``None``, the columns that are empty in the last
            row of every rollout.
        lines: Line number of each row in its file, for messages.
        units: Units by column name.

    Raises:
        DataError: The table does not have this layout.
    """
    names = rollout_checks.check_names(list(columns))
    for required in ("rollout", "time"):
        if required not in columns:
            raise DataError(
                f"there is no column {required}; the columns are "
                f"{rollout_checks.shown(', '.join(names))}{READ_AS_LOG}."
            )
    num_rows = len(columns["rollout"])
    if num_rows < 2:
        raise DataError(f"there are {num_rows} rows of data, but at least two are needed.")
    at = _Location(lines)
    bounds = _rollout_bounds(columns["rollout"], at)
    last_rows = bounds[1:] - 1
    data = [name for name in names if name not in ("rollout", "time")]
    stepwise = _stepwise_columns(columns, data, last_rows, actions)
    rewards = ["reward"] if "reward" in stepwise else []
    if "reward" in data and not rewards:
        raise DataError("the column reward must be empty in the last row of each rollout.")
    channel_names = [name for name in data if name not in stepwise]
    action_names = [name for name in data if name in stepwise and name != "reward"]
    for name in channel_names:
        if name in rollout_checks.RESERVED_NAMES:
            raise DataError(f"{name} is a reserved name, not a channel's or an action's.")
    spans = [slice(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    times = [columns["time"][span] for span in spans]
    units = units or {}
    if _is_uneven(columns, data, stepwise, times, last_rows):
        return _uneven(columns, channel_names, action_names, spans, units, bool(rewards))
    stepwise_spans = [slice(span.start, span.stop - 1) for span in spans]
    return Recording(
        readings=_matrices(columns, channel_names, spans),
        actions=_matrices(columns, action_names, stepwise_spans),
        channel_names=tuple(channel_names),
        action_names=tuple(action_names),
        time_step=rollout_checks.canonical_time_step(times),
        rewards=tuple(columns["reward"][span] for span in stepwise_spans) if rewards else None,
        time=tuple(times),
        channel_units=tuple(units.get(name, "") for name in channel_names),
        action_units=tuple(units.get(name, "") for name in action_names),
    )


def to_table(rollouts: Recording) -> dict[str, Array]:
    """Returns the columns that :func:`from_table` reads, NaN where a cell is empty.

    Measurements that were not taken at the times of the rows get rows of their own.
    """
    if rollouts.samplings:
        return _uneven_table(rollouts)
    empty = np.full((1, len(rollouts.action_names)), np.nan)
    readings = np.concatenate(rollouts.readings)
    actions = np.concatenate([part for values in rollouts.actions for part in (values, empty)])
    columns = {
        "rollout": np.repeat(np.arange(len(rollouts)), [len(t) for t in rollouts.time]),
        "time": np.concatenate(rollouts.time),
    }
    columns |= {name: readings[:, i] for i, name in enumerate(rollouts.channel_names)}
    columns |= {name: actions[:, i] for i, name in enumerate(rollouts.action_names)}
    if rollouts.rewards is not None:
        columns["reward"] = np.concatenate(
            [part for values in rollouts.rewards for part in (values, [np.nan])]
        )
    return columns


def _is_uneven(
    columns: Mapping[str, Array],
    data: Sequence[str],
    stepwise: set[str],
    times: Sequence[Array],
    last_rows: NDArray[np.int64],
) -> bool:
    """Returns whether values are missing, or time stamps are not those of a constant sampling."""
    for name in ("time", *data):
        is_empty = np.isnan(columns[name])
        if name in stepwise:
            is_empty[last_rows] = False
        if is_empty.any():
            return True
    try:
        rollout_checks.check_times(times)
        rollout_checks.canonical_time_step(times)
    except DataError:
        return True
    return False


def _uneven(
    columns: Mapping[str, Array],
    channel_names: Sequence[str],
    action_names: Sequence[str],
    spans: Sequence[slice],
    units: Mapping[str, str],
    has_rewards: bool,
) -> Recording:
    """Returns rollouts with missing values or uneven time stamps."""
    notes = [Remark("The time stamps are uneven; rewards are left out.")] if has_rewards else []
    rollouts, clocks, num_restarts = [], [], 0
    for span in spans:
        (time,), number = without_restarts((columns["time"][span],))
        num_restarts += number
        clocks.append(time)
        channels, actions = (
            [Track.of(time, columns[name][span]) for name in names]
            for names in (channel_names, action_names)
        )
        rollouts.append((channels, actions))
    return recording_of(
        rollouts,
        [(name, units.get(name, "")) for name in channel_names],
        [(name, units.get(name, "")) for name in action_names],
        notes=[*notes, *stamp_notes(clocks, num_restarts)],
    )


def _uneven_table(rollouts: Recording) -> dict[str, Array]:
    """Returns one row for each time at which a channel was measured or a step begins."""
    tables: list[dict[str, Array]] = []
    for index in range(len(rollouts)):
        channels, _ = tracks_of(rollouts, index)
        grid, actions = rollouts.time[index], rollouts.actions[index]
        time = np.unique(np.concatenate([grid, *(track.time for track in channels)]))
        table = {"rollout": np.full(len(time), float(index)), "time": time}
        for name, track in zip(rollouts.channel_names, channels, strict=True):
            table[name] = np.full(len(time), np.nan)
            table[name][np.searchsorted(time, track.time)] = track.values
        step = np.clip(np.searchsorted(grid, time, side="right") - 1, 0, len(actions) - 1)
        for name, values in zip(rollouts.action_names, actions.T, strict=True):
            table[name] = values[step]
            table[name][-1] = np.nan
        tables.append(table)
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


class _Location:
    """Describes the position of a row in a message."""

    def __init__(self, lines: Sequence[int] | None) -> None:
        self._lines = lines

    def __call__(self, row: int) -> str:
        return f" in row {row + 1}" if self._lines is None else f" in line {self._lines[row]}"


def _rollout_bounds(rollout: Array, at: _Location) -> NDArray[np.int64]:
    """Returns the first row of each rollout, followed by the total number of rows."""
    is_bad = ~((rollout >= 0) & (rollout < 1e9) & (np.floor(rollout) == rollout))
    if is_bad.any():
        row = int(np.argmax(is_bad))
        value = "empty" if np.isnan(rollout[row]) else f"{rollout[row]:.9g}"
        raise DataError(f"rollout is {value}{at(row)}, but it must count from 0.")
    starts = np.concatenate([[0], np.flatnonzero(np.diff(rollout)) + 1])
    if len(starts) > LIMITS.rollouts:
        raise DataError(f"it has {len(starts)} rollouts, more than {LIMITS.rollouts}.")
    seen: set[float] = set()
    for start in starts.tolist():
        identifier = float(rollout[start])
        if identifier in seen:
            raise DataError(
                f"rollout {identifier:.0f} begins again{at(start)}; the rows of a rollout must "
                "follow each other."
            )
        seen.add(identifier)
    bounds = np.concatenate([starts, [len(rollout)]])
    for index in np.flatnonzero(np.diff(bounds) < 2)[:1].tolist():
        raise DataError(
            f"rollout {rollout[bounds[index]]:.0f} has one row{at(int(bounds[index]))}, but at "
            "least two are needed."
        )
    return bounds


def _stepwise_columns(
    columns: Mapping[str, Array],
    data: Sequence[str],
    last_rows: NDArray[np.int64],
    actions: Sequence[str] | None,
) -> set[str]:
    """Returns the columns that have one value per step instead of one per sample."""
    is_empty = {name: np.isnan(columns[name][last_rows]) for name in data}
    if actions is not None:
        unknown = [name for name in actions if name not in data or name == "reward"]
        if unknown:
            raise DataError(f"there is no column {unknown[0]} to be an action.")
        return set(actions) | ({"reward"} & set(data))
    for name, empty in is_empty.items():
        if empty.any() and not empty.all():
            raise DataError(
                f"{name} is empty in the last row of rollout {int(np.argmax(empty))} but not of "
                f"rollout {int(np.argmin(empty))}."
            )
    stepwise = {name for name, empty in is_empty.items() if empty.all()}
    # A channel that was not always measured may be empty in the last rows, too.
    always = {name for name in stepwise if np.isnan(columns[name]).sum() == len(last_rows)}
    return always or stepwise


def _matrices(
    columns: Mapping[str, Array], names: Sequence[str], spans: Sequence[slice]
) -> tuple[Array, ...]:
    """Returns some columns of each rollout, ``(rows, len(names))``."""
    # One matrix of all rollouts, because a call of NumPy costs more than a short rollout's values.
    rows = np.zeros((len(columns["rollout"]), len(names)))
    for index, name in enumerate(names):
        rows[:, index] = columns[name]
    return tuple(rows[span] for span in spans)
