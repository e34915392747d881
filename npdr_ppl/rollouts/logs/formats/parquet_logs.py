"""Reads Parquet files and data frames with any columns."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.io.parquet_sizes import check_footer
from npdr_ppl.rollouts.logs.formats.tables import Texts, log_of_columns
from npdr_ppl.rollouts.logs.formats.time_stamps import in_seconds
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["columns_of_frame", "read_frame_log", "read_parquet_columns", "read_parquet_log"]

Array = NDArray[np.float64]

_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


def read_parquet_log(path: Path, settings: LogSettings) -> Log:
    """Reads a Parquet file with any columns: numbers, lists of numbers, times and text."""
    import pyarrow.parquet as pq
    import pyarrow.types as kinds

    columns = read_parquet_columns(path)
    with path.open("rb") as file:
        fields = pq.read_schema(file)
    dated = [f.name for f in fields if kinds.is_timestamp(f.type) or kinds.is_duration(f.type)]
    return log_of_columns(path.name, columns, settings, in_seconds=dated)


def read_parquet_columns(
    path: Path, wanted: Sequence[str] | None = None
) -> dict[str, Array | Texts]:
    """Returns the columns by name; times in s, vectors as ``(N, K)``.

    Args:
        path: The file.
        wanted: Names of the columns to read where the file has them; ``None`` for all.

    Raises:
        DataError: It is no Parquet file, or too large in memory.
    """
    import pyarrow.parquet as pq

    # A file object, because pyarrow may take a path for a data set of many files.
    with path.open("rb") as file:
        check_footer(file)
        parquet = pq.ParquetFile(file)
        schema, metadata = parquet.schema_arrow, parquet.metadata
        if len(schema) > LIMITS.columns or metadata.num_columns > LIMITS.columns:
            raise DataError(f"it has {len(schema)} columns, more than {LIMITS.columns}.")
        if len(set(schema.names)) < len(schema.names):
            raise DataError("two of its columns have the same name.")
        size = path.stat().st_size
        # Lists have more numbers than rows.
        groups = [metadata.row_group(k) for k in range(min(metadata.num_row_groups, LIMITS.parts))]
        numbers = sum(g.column(k).num_values for g in groups for k in range(g.num_columns))
        numbers = max(numbers, metadata.num_rows * metadata.num_columns)
        check_expansion(8.0 * numbers, size)
        names = [f.name for f in schema if _is_readable(f.type)]
        if wanted is not None:
            names = [name for name in names if name in wanted]
        table = parquet.read(columns=names, use_threads=False)
        return {n: _column(n, table.column(n), size) for n in names if n in table.column_names}


def columns_of_frame(frame: "pd.DataFrame") -> dict[str, Array | Texts]:
    """Returns the columns of a data frame, and its index where that is named or holds times."""
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise DataError(f"a pandas data frame is needed, not a {type(frame).__name__}.")
    columns: dict[str, Array | Texts] = {}
    for name, series in _all_series(frame):
        if name in columns:
            raise DataError(f"the column {rollout_checks.shown(name)} appears twice.")
        columns[name] = _series(series)
    return columns


def read_frame_log(frame: "pd.DataFrame", settings: LogSettings) -> Log:
    """Makes a log of a data frame."""
    columns = columns_of_frame(frame)
    dated = [name for name, series in _all_series(frame) if _is_dated(series)]
    return log_of_columns("data frame", columns, settings, in_seconds=dated)


def _all_series(frame: "pd.DataFrame") -> Iterator[tuple[str, Any]]:
    """Yields the index of a data frame, where it is named or holds times, and its columns."""
    import pandas as pd

    index = frame.index
    is_time = isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex)
    if is_time or (index.name is not None and str(index.name) not in frame.columns):
        yield str(index.name or "time"), index.to_series()
    for name, series in frame.items():
        yield str(name), series


def _is_dated(series: Any) -> bool:
    """Returns whether a column of a data frame holds dates or durations."""
    import pandas as pd

    return isinstance(series.dtype, pd.DatetimeTZDtype) or series.dtype.kind in "mM"


def _series(series: Any) -> Array | Texts:
    """Returns a column of a data frame: numbers, times in s, or text."""
    import pandas as pd

    if _is_dated(series):
        ticks = series.astype("int64").to_numpy()
        kind: Any = series.dtype
        unit = getattr(kind, "unit", None) or np.datetime_data(kind)[0]
        return np.where(series.isna(), np.nan, in_seconds(ticks, _PER_SECOND[unit]))
    if pd.api.types.is_numeric_dtype(series.dtype) and series.dtype.kind != "c":
        return _without_infinities(series.to_numpy(dtype=np.float64, na_value=np.nan))
    first = next((value for value in series if value is not None), None)
    if isinstance(first, list | tuple | np.ndarray):
        return _stacked(list(series))
    return ["" if pd.isna(value) else str(value) for value in series]


def _is_readable(kind: Any) -> bool:
    import pyarrow.types as kinds

    if kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind):
        return _is_number(kind.value_type)
    return (
        _is_number(kind)
        or kinds.is_timestamp(kind)
        or kinds.is_duration(kind)
        or kinds.is_boolean(kind)
        or kinds.is_string(kind)
        or kinds.is_large_string(kind)
    )


def _is_number(kind: Any) -> bool:
    import pyarrow.types as kinds

    return kinds.is_floating(kind) or kinds.is_integer(kind)


def _column(name: str, column: Any, size: int) -> Array | Texts:
    """Returns a column of a Parquet table: numbers, vectors, times in s, or text."""
    import pyarrow as pa
    import pyarrow.compute
    import pyarrow.types as kinds

    pc: Any = pyarrow.compute  # its functions are made at import
    kind = column.type
    if kinds.is_string(kind) or kinds.is_large_string(kind):
        if column.nbytes > LIMITS.free_bytes:
            raise DataError(f"the text of {rollout_checks.shown(name)} is too long.")
        return [value or "" for value in column.to_pylist()]
    if kinds.is_timestamp(kind) or kinds.is_duration(kind):
        known = column.is_valid().to_numpy(zero_copy_only=False)
        ticks = pc.fill_null(column.cast(pa.int64()), 0).to_numpy()
        return np.where(known, in_seconds(ticks, _PER_SECOND[kind.unit]), np.nan)
    if kinds.is_boolean(kind):
        column = column.cast(pa.int8())
    if hasattr(kind, "value_type"):
        lengths = pc.list_value_length(column)
        longest = pc.max(lengths).as_py() or 0
        check_expansion(8.0 * longest * len(column), size)
        if longest > LIMITS.columns:
            raise DataError(f"{rollout_checks.shown(name)} holds lists of {longest} numbers.")
        flat = column.combine_chunks().flatten() if len(column) else column
        if len(column) and longest * len(column) == len(flat):
            values = np.asarray(flat.to_numpy(zero_copy_only=False), dtype=np.float64)
            return _without_infinities(values.reshape(len(column), longest))
        return _stacked(column.to_pylist())
    return _without_infinities(np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64))


def _stacked(rows: Sequence[Any]) -> Array:
    """Returns lists of numbers as ``(N, K)``, NaN where one is shorter than the longest."""
    parts = [np.ravel(np.asarray([] if r is None else r, dtype=np.float64)) for r in rows]
    longest = max((len(part) for part in parts), default=0)
    if longest > LIMITS.columns or longest * len(parts) > LIMITS.numbers:
        raise DataError(f"a column holds vectors of {longest} numbers.")
    result = np.full((len(parts), longest), np.nan)
    for index, part in enumerate(parts):
        result[index, : len(part)] = part
    return _without_infinities(result)


def _without_infinities(values: Array) -> Array:
    values = np.array(values, dtype=np.float64)
    values[np.isinf(values)] = np.nan
    return values
