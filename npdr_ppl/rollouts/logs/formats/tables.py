"""Makes signals of the columns of a table, whichever format the table came from."""

import re
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime

import msgspec
import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.episodes import episodes_in, shift_of_episodes
from npdr_ppl.rollouts.logs.formats.time_stamps import (
    MAX_CLOCK_DIFFERENCE,
    is_stamp,
    seconds_of,
    time_name,
)
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.logs.log_settings import HOW_TO_NAME_TIME, LogSettings, time_unit_of
from npdr_ppl.rollouts.logs.nearest_names import missing
from npdr_ppl.rollouts.notes import Remark

__all__ = ["Columns", "Texts", "log_of_columns", "numbers_of"]

Array = NDArray[np.float64]

Texts = list[str]
"""A column of text, one cell per row."""

Columns = Mapping[str, "Array | Texts"]
"""Columns by name: numbers ``(N,)`` or vectors ``(N, K)``, NaN where one is missing, or text."""

_WORDS = {
    **dict.fromkeys(("", "nan", "na", "n/a", "null", "none", "-", "inf", "+inf", "-inf"), np.nan),
    **{"true": 1.0, "false": 0.0},
}
"""What words stand for, in lower case; a value that was not recorded is NaN."""

_VECTOR = re.compile(r"\s*[\[(]([-+.\deE,;\snaifNI]*)[\])]\s*")

_NUMBER_CHARACTERS = frozenset("0123456789+-.eE")

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def numbers_of(cells: Sequence[str], *, comma: bool = False) -> Array | None:
    """Returns the numbers in cells of text, ``(N,)``; ``None`` if a cell holds something else.

    Args:
        cells: Text of each cell; an empty one is a value that was not recorded.
        comma: Whether decimals may be written with a comma.
    """
    if comma:
        cells = [cell.replace(",", ".") for cell in cells]
    if _NUMBER_CHARACTERS.issuperset("".join(cells)):
        try:
            values = np.array([float(cell) if cell else np.nan for cell in cells])
        except ValueError:
            return None  # e.g. 1-2, or a date
        values[np.isinf(values)] = np.nan
        return values
    values = np.empty(len(cells))
    for row, cell in enumerate(cells):
        if _NUMBER.fullmatch(cell):
            values[row] = float(cell)
            continue
        word = _WORDS.get(cell.strip().lower())
        if word is None:
            word = float(cell) if _NUMBER.fullmatch(cell.strip()) else None
        if word is None:
            return None
        values[row] = word
    values[np.isinf(values)] = np.nan
    return values


def log_of_columns(
    source: str,
    columns: Columns,
    settings: LogSettings,
    *,
    prefix: str = "",
    components: Mapping[str, Sequence[str]] | Sequence[str] = (),
    units: Mapping[str, str] | None = None,
    in_seconds: Collection[str] = (),
) -> Log:
    """Makes a log of a table.

    A row holds values of one time. A cell that is empty was not recorded at that time.

    Args:
        source: Name of the file, for messages.
        columns: The columns, of equal length.
        settings: Which column holds the time stamps, and their unit.
        prefix: Text in front of each signal's name, if other tables share the clock. Then no
            column marks episodes here.
        components: Names of the components of vectors: by column, or one list for all vectors of
            its length. Other vectors number their components from 0.
        units: Units by column.
        in_seconds: Names of the columns that hold times in s, because their type states a unit.

    Raises:
        DataError: There is no time, or a column that the settings name is missing.
    """
    notes: list[str] = []
    about = f"{prefix.rstrip('/')}: " if prefix else ""
    columns = _with_joined_stamps(columns)
    rows = len(next(iter(columns.values()), ()))
    chosen = settings.time or time_name(columns) or _unnamed(columns)
    if chosen is not None:
        if chosen not in columns:
            raise DataError(missing("column", chosen, columns))
        stated = time_unit_of((units or {}).get(chosen, ""))
        own = msgspec.structs.replace(settings, time_unit=settings.time_unit or stated)
        time, note = _seconds(chosen, columns[chosen], own, in_seconds)
        notes += [Remark(f"{about}{note}.")] if note else []
    elif settings.time_step is not None:
        time = np.arange(rows) * np.float64(settings.time_step)
        notes.append(Remark(f"there is no time column; rows are {settings.time_step:g} s apart."))
    else:
        raise DataError(
            f"no column looks like time stamps; the columns are "
            f"{rollout_checks.shown(', '.join(columns), 200)}; {HOW_TO_NAME_TIME}"
        )
    numbers: dict[str, Array] = {}
    skipped: list[str] = []
    total = 0
    for name, values in columns.items():
        if name == chosen or not name:
            continue
        for key, series in _components(name, values, components):
            if series is None:
                skipped.append(name)
                continue
            total += len(series)
            if len(numbers) >= LIMITS.columns or total > LIMITS.numbers:
                raise DataError(f"it has more than {LIMITS.columns} signals.")
            numbers[key] = series
    if skipped:
        told = rollout_checks.shown(", ".join(skipped), 200)
        notes.append(Remark(f"{about}text was left out: {told}."))
    shift, episodes = np.zeros(len(time)), ""
    if not prefix:  # tables of a folder have one clock, which goes on for all of them later
        episodes, remark = episodes_in(time, numbers, settings)
        notes += [remark] if remark else []
    if episodes in numbers:
        shift = shift_of_episodes(time, numbers[episodes])
    stamps: dict[str, Array] = {}
    if not settings.time:
        stamps, different = _stamps(numbers, time, settings, in_seconds)
        notes += [
            Remark(
                f"{rollout_checks.shown(name)} differs from the time of the table by "
                f"{difference:.3g} s and is not used."
            )
            for name, difference in different.items()
        ]
    signals = []
    time = time + shift
    is_timed = np.isfinite(time)
    for name, values in numbers.items():
        if name in stamps:
            continue
        own = next((s for s in stamps if name.startswith(s[: -len("header/stamp")])), None)
        is_known = np.isfinite(values)
        at = (
            time
            if own is None
            else np.where(np.isfinite(stamps[own]), stamps[own], np.nan) + shift
        )
        keep = is_known & (is_timed if own is None else np.isfinite(at))
        unit = (units or {}).get(name, "")
        signals.append(
            Signal(f"{prefix}{name}", at, values.copy(), unit)
            if keep.all()
            else Signal(f"{prefix}{name}", at[keep], values[keep], unit)
        )
    notes += [
        Remark(f"the signals beside {rollout_checks.shown(s)} have its time.") for s in stamps
    ]
    return Log(source, tuple(signals), tuple(notes), episodes if episodes in numbers else "")


def _with_joined_stamps(columns: Columns) -> Columns:
    """Returns columns in which seconds and nanoseconds of a stamp have become one column in s."""
    joined = dict(columns)
    for name in columns:
        found = re.fullmatch(r"(.*stamp)([./])(secs?)", name)
        if found is None:
            continue
        rest = [f"{found[1]}{found[2]}{word}" for word in ("nanosec", "nanosecs", "nsecs", "nsec")]
        fine = next((other for other in rest if other in columns), None)
        whole = columns[name]
        parts = columns[fine] if fine else None
        if fine and isinstance(whole, np.ndarray) and isinstance(parts, np.ndarray):
            joined[found[1]] = whole + parts / 1e9
            del joined[name], joined[fine]
    return joined


def _unnamed(columns: Columns) -> str | None:
    """Returns the first column if it has no name, increases, and does not merely count rows."""
    first = next(iter(columns), None)
    if first is None or first.strip() not in ("", "Unnamed: 0", "column_0"):
        return None
    values = columns[first]
    if isinstance(values, list) or values.ndim != 1 or len(values) < 2:
        return None
    steps = np.diff(values)
    return first if (steps > 0).all() and not (steps == 1).all() else None


def _seconds(
    name: str, values: Array | Texts, settings: LogSettings, in_seconds: Collection[str]
) -> tuple[Array, str]:
    """Returns the time stamps of a column in s, and what was guessed."""
    if isinstance(values, list):
        try:
            dates = [datetime.fromisoformat(cell.strip()) for cell in values]
            zoned = [d if d.tzinfo else d.replace(tzinfo=UTC) for d in dates]
            return np.array([d.timestamp() for d in zoned]), ""
        except (ValueError, OverflowError):
            raise DataError(
                f"the time column {rollout_checks.shown(name)} holds text that is neither a "
                "number nor a date."
            ) from None
    if values.ndim != 1:
        raise DataError(f"the time column {rollout_checks.shown(name)} holds vectors.")
    return (values, "") if name in in_seconds else seconds_of(name, values, settings)


def _stamps(
    numbers: Mapping[str, Array],
    time: Array,
    settings: LogSettings,
    in_seconds: Collection[str],
) -> tuple[dict[str, Array], dict[str, float]]:
    """Returns the stamps of messages that can be used, and the differences of the others.

    Args:
        numbers: Columns by name.
        time: Time stamps of the rows in s, ``(N,)``.
        settings: How the log is read.
        in_seconds: Names of the columns that hold times in s.

    Returns:
        Stamps in s by column, and the median difference in s between the two clocks by column.
    """
    found, different = {}, {}
    for name, values in numbers.items():
        if not is_stamp(name) or not np.isfinite(values).any():
            continue
        stamps = _seconds(name, values, settings, in_seconds)[0]
        is_known = np.isfinite(stamps) & np.isfinite(time)
        difference = float(np.median((time - stamps)[is_known])) if is_known.any() else np.nan
        if abs(difference) <= MAX_CLOCK_DIFFERENCE:
            found[name] = stamps
        else:
            different[name] = difference
    return found, different


def _components(
    name: str, values: Array | Texts, names: Mapping[str, Sequence[str]] | Sequence[str]
) -> list[tuple[str, Array | None]]:
    """Returns the signals of a column with their names, or ``None`` for text."""
    vectors = _vectors(values) if isinstance(values, list) else values
    if vectors is None:
        return [(name, None)]
    if vectors.ndim == 1:
        return [(name, vectors)]
    count = vectors.shape[1]
    words = names.get(name, ()) if isinstance(names, Mapping) else names
    if len(words) != count:
        return [(f"{name}.{k}", vectors[:, k]) for k in range(count)]
    joint = "." if isinstance(names, Mapping) else "/"
    return [(f"{name}{joint}{word}", vectors[:, k]) for k, word in enumerate(words)]


def _vectors(cells: Texts) -> Array | None:
    """Returns the vectors in cells such as ``[0.1, 0.2]``, ``(N, K)``, or ``None`` for text."""
    # Rows go into an array at once, because a list takes four times the memory. Its width doubles
    # when a row is longer, so that it is seldom copied.
    longest = 0
    result = np.empty((len(cells), 0))
    for index, cell in enumerate(cells):
        if not cell.strip():
            continue
        try:
            values = _DECODER.decode(cell)
        except msgspec.DecodeError:
            values = _unusual_vector(cell)
        if values is None:
            return None
        longest = max(longest, len(values))
        if longest > LIMITS.columns or longest * len(cells) > LIMITS.numbers:
            return None
        if longest > (width := result.shape[1]):
            wider = np.full((len(cells), max(longest, 2 * width)), np.nan)
            wider[:index, :width] = result[:index]
            result = wider
        result[index, : len(values)] = values
    return result[:, :longest] if longest else None


_DECODER = msgspec.json.Decoder(list[float])


def _unusual_vector(cell: str) -> list[float] | None:
    """Returns the numbers of a vector that is not written as in JSON, e.g. ``(1; nan)``."""
    found = _VECTOR.fullmatch(cell)
    if found is None:
        return None
    values = numbers_of(re.split(r"\s*[,;]\s*|\s+", found[1].strip()))
    return None if values is None else values.tolist()
