"""The table layout of CSV and Parquet: one row per sample, rollouts one after another.

Measurements that were not taken at equal steps have rows of their own. A table with such rows has
the column ``step``: it counts the rows at which the steps of a rollout begin or the last one ends,
and is empty in the other rows. Actions and rewards are in the rows at which steps begin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.clock_jumps import stamp_notes, without_jumps
from npdr_ppl.rollouts.gridding import MOST_LOST, Gridded, on_given_grids, recording_of, tracks_of
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.tracks import Track

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
    time_step: float | None = None,
) -> Recording:
    """Splits a table into rollouts.

    Args:
        columns: Values by name, ``(N,)`` each, NaN where a cell is empty.
        actions: Names of the action columns; if ``None``, the columns that are empty in the last
            row of every rollout, and nearly nowhere else.
        lines: Line number of each row in its file, for messages.
        units: Units by column name.
        time_step: Seconds between the steps; ``None`` to take it from the time stamps.

    Raises:
        DataError: The table does not have this layout.
    """
    if time_step is not None:
        rollout_checks.check_time_step(time_step)
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
    spans = [slice(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    grids = _grid_rows(columns, spans) if "step" in columns else None
    data = [name for name in names if name not in ("rollout", "time", "step")]
    if actions is None and grids is not None:
        stepwise = _columns_of_steps(columns, data, grids)
    else:
        stepwise = _stepwise_columns(columns, data, last_rows, actions)
    rewards = ["reward"] if "reward" in stepwise else []
    if "reward" in data and not rewards:
        raise DataError("the column reward must be empty in the last row of each rollout.")
    channel_names = [name for name in data if name not in stepwise]
    action_names = [name for name in data if name in stepwise and name != "reward"]
    for name in channel_names:
        if name in rollout_checks.RESERVED_NAMES:
            raise DataError(f"{name} is a reserved name, not a channel's or an action's.")
    times = [columns["time"][span] for span in spans]
    units = units or {}
    if grids is not None:
        return _on_grids(columns, channel_names, action_names, grids, spans, units, time_step)
    if _is_uneven(columns, data, stepwise, times, last_rows):
        return _uneven(
            columns, channel_names, action_names, spans, units, bool(rewards), time_step
        )
    stepwise_spans = [slice(span.start, span.stop - 1) for span in spans]
    return Recording(
        readings=_matrices(columns, channel_names, spans),
        actions=_matrices(columns, action_names, stepwise_spans),
        channel_names=tuple(channel_names),
        action_names=tuple(action_names),
        time_step=time_step or rollout_checks.canonical_time_step(times),
        rewards=tuple(columns["reward"][span] for span in stepwise_spans) if rewards else None,
        time=tuple(times),
        channel_units=tuple(units.get(name, "") for name in channel_names),
        action_units=tuple(units.get(name, "") for name in action_names),
    )


def to_table(rollouts: Recording) -> dict[str, Array]:
    """Returns the columns that :func:`from_table` reads, NaN where a cell is empty.

    Measurements that were not taken at equal steps get rows of their own.
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
    time_step: float | None,
) -> Recording:
    """Returns rollouts with missing values or uneven time stamps."""
    notes = [Remark("The time stamps are uneven; rewards are left out.")] if has_rewards else []
    rollouts, clocks, jumps = [], [], []
    for span in spans:
        (time,), found = without_jumps((columns["time"][span],), 1)
        jumps.append(found)
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
        time_step=time_step,
        notes=[*notes, *stamp_notes(clocks, jumps)],
    )


def _grid_rows(columns: Mapping[str, Array], spans: Sequence[slice]) -> list[NDArray[np.int64]]:
    """Returns the rows of the table at which the steps of each rollout begin or end, ``(T + 1,)``.

    Raises:
        DataError: The column step does not count them.
    """
    result = []
    for index, span in enumerate(spans):
        step = columns["step"][span]
        rows = np.flatnonzero(~np.isnan(step))
        if len(rows) < 2 or not np.array_equal(step[rows], np.arange(len(rows))):
            raise DataError(
                f"the column step does not count the steps of rollout {index} from 0; without "
                "this column, steps are made of the time stamps."
            )
        result.append(rows + span.start)
    return result


def _columns_of_steps(
    columns: Mapping[str, Array], data: Sequence[str], grids: Sequence[NDArray[np.int64]]
) -> set[str]:
    """Returns the columns with values in the rows at which steps begin, and nowhere else."""
    begins = np.concatenate([rows[:-1] for rows in grids])
    expected = np.zeros(len(columns["time"]), dtype=bool)
    expected[begins] = True
    found = {name for name in data if np.array_equal(~np.isnan(columns[name]), expected)}
    return found if len(found) < len(data) else set()


def _on_grids(
    columns: Mapping[str, Array],
    channel_names: Sequence[str],
    action_names: Sequence[str],
    grids: Sequence[NDArray[np.int64]],
    spans: Sequence[slice],
    units: Mapping[str, str],
    time_step: float | None,
) -> Recording:
    """Returns rollouts of which the table says at which rows steps begin."""
    times = [columns["time"][rows] for rows in grids]
    rollout_checks.check_values([time[:, None] for time in times], ("time",))
    rollout_checks.check_times(times)
    step = time_step or rollout_checks.canonical_time_step(times)
    parts = [
        Gridded.of(
            [Track.of(columns["time"][span], columns[name][span]) for name in channel_names],
            time,
            np.stack([columns[name][rows[:-1]] for name in action_names], axis=1)
            if action_names
            else np.zeros((len(rows) - 1, 0)),
            step,
        )
        for span, rows, time in zip(spans, grids, times, strict=True)
    ]
    recording = on_given_grids(
        parts,
        [(name, units.get(name, "")) for name in channel_names],
        [(name, units.get(name, "")) for name in action_names],
        time_step=step,
    )
    if "reward" not in columns:
        return recording
    return replace(recording, rewards=tuple(columns["reward"][rows[:-1]] for rows in grids))


def _uneven_table(rollouts: Recording) -> dict[str, Array]:
    """Returns one row for each time at which a channel was measured or a step begins."""
    tables: list[dict[str, Array]] = []
    for index in range(len(rollouts)):
        channels, _ = tracks_of(rollouts, index)
        grid = rollouts.time[index]
        time = np.unique(np.concatenate([grid, *(track.time for track in channels)]))
        rows = np.searchsorted(time, grid)

        def column(rows: NDArray[np.int64], values: Array, size: int = len(time)) -> Array:
            cells = np.full(size, np.nan)
            cells[rows] = values
            return cells

        table = {
            "rollout": np.full(len(time), float(index)),
            "time": time,
            "step": column(rows, np.arange(len(grid), dtype=np.float64)),
        }
        for name, track in zip(rollouts.channel_names, channels, strict=True):
            table[name] = column(np.searchsorted(time, track.time), track.values)
        for name, values in zip(rollouts.action_names, rollouts.actions[index].T, strict=True):
            table[name] = column(rows[:-1], values)
        if rollouts.rewards is not None:
            table["reward"] = column(rows[:-1], rollouts.rewards[index])
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
    missing = {name: int(np.isnan(columns[name]).sum()) - len(last_rows) for name in stepwise}
    always = {name for name in stepwise if not missing[name]}
    if always:
        return always
    most = (1.0 - MOST_LOST) * len(columns["rollout"])
    nearly = {name for name in stepwise if missing[name] <= most}
    return nearly if len(nearly) < len(data) else set()


def _matrices(
    columns: Mapping[str, Array], names: Sequence[str], spans: Sequence[slice]
) -> tuple[Array, ...]:
    """Returns some columns of each rollout, ``(rows, len(names))``."""
    # One matrix of all rollouts, because a call of NumPy costs more than a short rollout's values.
    rows = np.zeros((len(columns["rollout"]), len(names)))
    for index, name in enumerate(names):
        rows[:, index] = columns[name]
    return tuple(rows[span] for span in spans)
