"""Reads LeRobot data sets, versions 2.1 and 3.0: a folder of Parquet files and JSON."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.folders import check_inside, files_in
from npdr_ppl.rollouts.logs.formats.parquet_logs import read_parquet_columns
from npdr_ppl.rollouts.logs.formats.tables import Texts, log_of_columns
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

__all__ = ["read_lerobot"]

Array = NDArray[np.float64]

_NUMBERS = ("float32", "float64", "int64", "int32", "int16", "int8", "uint8", "bool")

_UNUSED = ("index", "frame_index", "task_index")
"""Columns that only count."""


class _Feature(msgspec.Struct):
    """A column, as ``info.json`` describes it."""

    dtype: str = ""
    shape: list[int] = []
    names: Any = None


class _Info(msgspec.Struct):
    """The part of ``info.json`` that is read."""

    codebase_version: str
    features: dict[str, _Feature]


def read_lerobot(path: Path, settings: LogSettings) -> Log:
    """Reads the numbers of all episodes; images and videos are left out.

    The components of vectors have the names of ``meta/info.json``, e.g.
    ``observation.state.shoulder_pan.pos``. The time stamps of the data set begin anew in each
    episode; here they go on.

    Args:
        path: The folder.
        settings: How to read it.

    Raises:
        DataError: It is damaged, of another version, or a link leads out of it.
    """
    info = _info(path)
    version = info.codebase_version.removeprefix("v")
    if version not in ("2.0", "2.1", "3.0"):
        raise DataError(
            f"its version is {rollout_checks.shown(info.codebase_version)}, but versions 2.0, 2.1 "
            "and 3.0 are read."
        )
    wanted = [n for n, f in info.features.items() if f.dtype in _NUMBERS and n not in _UNUSED]
    wanted += [n for n in ("timestamp", "episode_index") if n not in wanted]
    files = files_in(path, ".parquet", "data/chunk-*/*.parquet")
    if not files:
        raise DataError("there are no files data/chunk-…/….parquet in it.")
    parts: dict[str, list[Array | Texts]] = {}
    total = 0
    for file in files:
        rollout_checks.check_file(file)
        with rollout_checks.named(file):
            columns = read_parquet_columns(file, wanted)
        if parts and set(columns) != set(parts):
            raise DataError(f"{file.name} has other columns than the first file.")
        for name, values in columns.items():
            parts.setdefault(name, []).append(values)
            total += values.size if isinstance(values, np.ndarray) else len(values)
        if total > LIMITS.numbers:
            raise DataError(f"it has more than {LIMITS.numbers:.0e} numbers.")
    joined: dict[str, Array | Texts] = {}
    for name, pieces in parts.items():
        arrays = [piece for piece in pieces if isinstance(piece, np.ndarray)]
        if len(arrays) < len(pieces):
            continue  # text
        if len({a.shape[1:] for a in arrays}) > 1:
            raise DataError(f"the vectors {rollout_checks.shown(name)} differ in length.")
        joined[name] = np.concatenate(arrays)
    if "timestamp" not in joined or "episode_index" not in joined:
        raise DataError("it has no columns timestamp and episode_index.")
    joined = _in_order(joined)
    names = {name: _names(info.features[name]) for name in joined if name in info.features}
    if settings.time is None:
        settings = msgspec.structs.replace(settings, time="timestamp", time_unit="s")
    return log_of_columns(path.name, joined, settings, components=names)


def _info(path: Path) -> _Info:
    file = check_inside(path, path / "meta" / "info.json")
    rollout_checks.check_file(file)
    if file.stat().st_size > LIMITS.json_bytes:
        raise DataError("info.json is too long.")
    try:
        return msgspec.json.decode(file.read_bytes(), type=_Info)
    except (msgspec.DecodeError, RecursionError):
        raise DataError("meta/info.json does not describe a LeRobot data set.") from None


def _in_order(columns: dict[str, Array | Texts]) -> dict[str, Array | Texts]:
    """Returns the rows episode by episode, each in the order of time."""
    arrays = {name: values for name, values in columns.items() if isinstance(values, np.ndarray)}
    episode, stamps = arrays["episode_index"], arrays["timestamp"]
    if episode.ndim != 1 or stamps.ndim != 1:
        # Some writers store each number as a list of one.
        arrays = {n: v[:, 0] if v.ndim == 2 and v.shape[1] == 1 else v for n, v in arrays.items()}
        episode, stamps = arrays["episode_index"], arrays["timestamp"]
        if episode.ndim != 1 or stamps.ndim != 1:
            raise DataError("timestamp and episode_index should hold one number per row.")
    order = np.lexsort((stamps, episode))
    return {name: values[order] for name, values in arrays.items()}


def _names(feature: _Feature) -> list[str]:
    """Returns the names of a vector's components, without any if they are not plain text."""
    names = feature.names
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))  # e.g. {"motors": [...]}
    if not isinstance(names, list) or len(names) > LIMITS.columns:
        return []
    is_plain = all(isinstance(n, str) and 0 < len(n) <= 100 and n.isprintable() for n in names)
    return names if is_plain and len(set(names)) == len(names) else []
