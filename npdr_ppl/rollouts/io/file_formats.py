"""Reads and writes Parquet, NPZ, NetCDF and xarray: exact, with units and without pickles."""

import json
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import DataError
from npdr_ppl.hdf5_checks import check_self_contained
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.collection import stacked
from npdr_ppl.rollouts.io.csv_files import read_csv
from npdr_ppl.rollouts.io.npz_arrays import read_arrays
from npdr_ppl.rollouts.io.parquet_sizes import check_footer, check_parquet
from npdr_ppl.rollouts.io.tables import from_table, to_table
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.sampling import Sampling

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "from_xarray",
    "load",
    "read_netcdf",
    "read_npz",
    "read_parquet",
    "to_xarray",
    "write_netcdf",
    "write_npz",
    "write_parquet",
]

AnyPath = str | PathLike[str]

_METADATA_KEY = b"npdr_ppl"


class _TableMetadata(msgspec.Struct):
    """What a Parquet file says beside the table; the exact time step differs from its stamps."""

    units: dict[str, str] = {}
    time_step: float | None = None
    actions: list[str] | None = None


_NPZ_ARRAYS = {  # name of each array and its number of dimensions
    "readings": 3,
    "actions": 3,
    "time": 2,
    "lengths": 1,
    "time_step": 0,
    "channel_names": 1,
    "action_names": 1,
    "channel_units": 1,
    "action_units": 1,
}


def load(path: AnyPath) -> Recording:
    """Reads rollouts in the format given by the suffix; see :meth:`Rollouts.load`."""
    readers = {
        ".csv": lambda file: read_csv(file, None),
        ".parquet": lambda file: read_parquet(file, None),
        ".npz": read_npz,
        ".nc": read_netcdf,
    }
    rollout_checks.check_file(path)
    suffix = Path(path).suffix.lower()
    if suffix not in readers:
        with rollout_checks.named(path):
            raise DataError(
                f"the suffix {rollout_checks.shown(suffix)} is unknown; rollouts are read from "
                f"{', '.join(readers)} files."
            )
    return readers[suffix](path)


# -- Parquet ---------------------------------------------------------------------------------


def write_parquet(rollouts: Recording, path: AnyPath) -> None:
    """Writes a table; see :meth:`Rollouts.to_parquet`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {
        name: pa.array(values, from_pandas=True) for name, values in to_table(rollouts).items()
    }
    units = dict(zip(rollouts.channel_names, rollouts.channel_units, strict=True))
    units |= dict(zip(rollouts.action_names, rollouts.action_units, strict=True))
    about = {
        "units": units,
        "time_step": rollouts.time_step,
        "actions": rollouts.action_names,
    }
    metadata = {_METADATA_KEY: json.dumps(about)}
    with replacing(path) as temporary:
        pq.write_table(pa.table(columns).replace_schema_metadata(metadata), temporary)


def read_parquet(path: AnyPath, actions: Sequence[str] | None) -> Recording:
    """Reads a table; see :meth:`Rollouts.from_parquet`."""
    import pyarrow.parquet as pq

    path = rollout_checks.check_file(path)
    with rollout_checks.named(path):
        with rollout_checks.refusing("Parquet file"):
            # A file object, because pyarrow may take a path for a data set of many files.
            with path.open("rb") as file:
                check_footer(file)
                parquet = pq.ParquetFile(file)
                check_parquet(parquet, path.stat().st_size)
                # A thread for each column would decompress all of them at once.
                table = parquet.read(use_threads=False)
            columns = {
                name: np.asarray(column.to_numpy(), dtype=np.float64)
                for name, column in zip(table.column_names, table.columns, strict=True)
            }
            metadata = (table.schema.metadata or {}).get(_METADATA_KEY, b"{}")
            about = msgspec.json.decode(metadata, type=_TableMetadata)
        if actions is None and about.actions is not None:
            # Another program may have removed columns.
            actions = [name for name in about.actions if name in columns]
        return from_table(columns, actions, units=about.units, time_step=about.time_step)


# -- NPZ -------------------------------------------------------------------------------------


def write_npz(rollouts: Recording, path: AnyPath) -> None:
    """Writes padded arrays; see :meth:`Rollouts.to_npz`."""
    readings, actions, _ = stacked(rollouts)
    arrays: dict[str, Any] = {
        "readings": readings,
        "actions": actions,
        "time": _padded(rollouts.time, 0.0),
        "lengths": np.array(rollouts.lengths),
        "time_step": np.array(rollouts.time_step),
        "channel_names": np.array(rollouts.channel_names, dtype=np.str_),
        "action_names": np.array(rollouts.action_names, dtype=np.str_),
        "channel_units": np.array(rollouts.channel_units, dtype=np.str_),
        "action_units": np.array(rollouts.action_units, dtype=np.str_),
    }
    if rollouts.rewards is not None:
        arrays["rewards"] = _padded(rollouts.rewards, 0.0)
    if rollouts.samplings:
        arrays["measured"] = _padded([_measured(s) for s in rollouts.samplings], np.nan)
        arrays["lateness"] = _padded([s.lateness for s in rollouts.samplings], 0.0)
    if not rollouts.is_whole:
        arrays["usable"] = _padded(_usable(rollouts), 0.0)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_npz(path: AnyPath) -> Recording:
    """Reads padded arrays; see :meth:`Rollouts.from_npz`."""
    path = rollout_checks.check_file(path)
    with rollout_checks.named(path), rollout_checks.refusing("NPZ file"):
        optional = {"rewards": 2, "measured": 3, "lateness": 3, "usable": 2}
        arrays = read_arrays(path, _NPZ_ARRAYS, optional)
        lengths = arrays["lengths"].tolist()
        if any(not 1 <= n < arrays["readings"].shape[1] for n in lengths):
            raise DataError("the array lengths does not fit the array readings.")

        def cut(name: str, extra: int) -> list[NDArray[Any]]:
            return [values[: n + extra] for values, n in zip(arrays[name], lengths, strict=True)]

        def words(name: str) -> list[str]:
            return [str(word) for word in arrays[name].tolist()]

        recording = Recording.from_arrays(
            cut("readings", 1),
            cut("actions", 0),
            channel_names=words("channel_names"),
            action_names=words("action_names"),
            time_step=float(arrays["time_step"]),
            rewards=cut("rewards", 0) if "rewards" in arrays else None,
            time=cut("time", 1),
            channel_units=words("channel_units"),
            action_units=words("action_units"),
        )
        is_sampled = "measured" in arrays and "lateness" in arrays
        return _with_sampling(
            recording,
            cut("measured", 1) if is_sampled else (),
            cut("lateness", 1) if is_sampled else (),
            cut("usable", 0) if "usable" in arrays else (),
        )


def _measured(sampling: Sampling) -> NDArray[np.float64]:
    """Returns the measurements as they were taken, NaN where there is none, ``(T + 1, C)``."""
    return np.where(sampling.is_read, sampling.values, np.nan)


def _usable(rollouts: Recording) -> list[NDArray[np.float64]]:
    """Returns one for each usable step of each rollout, zero for the others, ``(T,)`` each."""
    result = []
    for length, spans in zip(rollouts.lengths, rollouts.spans, strict=True):
        steps = np.zeros(length)
        for first, end in spans:
            steps[first:end] = 1.0
            # Stretches that touch each other are kept apart.
            steps[end - 1] = 2.0
        result.append(steps)
    return result


def _with_sampling(
    recording: Recording,
    measured: Sequence[NDArray[np.float64]],
    lateness: Sequence[NDArray[np.float64]],
    usable: Sequence[NDArray[np.float64]],
) -> Recording:
    """Returns a recording with what the functions above have written; empty if nothing was."""
    samplings = tuple(
        Sampling(np.where(np.isnan(m), r, m), np.where(np.isnan(m), 0.0, late), ~np.isnan(m))
        for m, late, r in zip(measured, lateness, recording.readings, strict=False)
    )
    spans = []
    for steps in usable:
        ends = np.flatnonzero(steps == 2.0) + 1
        begins = [
            int(np.flatnonzero(steps[a:end] > 0)[0] + a)
            for a, end in zip([0, *ends[:-1]], ends, strict=True)
        ]
        spans.append(tuple(zip(begins, ends.tolist(), strict=True)))
    return replace(recording, samplings=samplings, stretches=tuple(spans))


# -- xarray and NetCDF -----------------------------------------------------------------------


def to_xarray(rollouts: Recording) -> "xr.Dataset":
    """Returns a data set; see :meth:`Rollouts.to_xarray`."""
    import xarray as xr

    dimensions = ("rollout", "step")
    readings = _padded(rollouts.readings, np.nan)
    longest = max(rollouts.lengths)
    actions = np.full((len(rollouts), longest + 1, len(rollouts.action_names)), np.nan)
    for index, values in enumerate(rollouts.actions):
        actions[index, : len(values)] = values
    variables: dict[str, Any] = {
        "num_steps": ("rollout", np.array(rollouts.lengths), {"kind": "length"})
    }
    for kind, names, units, values in (
        ("channel", rollouts.channel_names, rollouts.channel_units, readings),
        ("action", rollouts.action_names, rollouts.action_units, actions),
    ):
        for index, name in enumerate(names):
            attributes = {"kind": kind, "units": units[index], "position": index}
            variables[name] = (dimensions, values[:, :, index], attributes)
    if rollouts.rewards is not None:
        rewards = np.full((len(rollouts), longest + 1), np.nan)
        for index, values in enumerate(rollouts.rewards):
            rewards[index, : len(values)] = values
        variables["reward"] = (dimensions, rewards, {"kind": "reward"})
    if rollouts.samplings:
        measured = _padded([_measured(s) for s in rollouts.samplings], np.nan)
        lateness = _padded([s.lateness for s in rollouts.samplings], 0.0)
        for kind, parts in (("measured", measured), ("lateness", lateness)):
            for index, name in enumerate(rollouts.channel_names):
                attributes = {"kind": kind, "position": index}
                variables[f"{name}.{kind}"] = (dimensions, parts[:, :, index], attributes)
    if not rollouts.is_whole:
        usable = np.zeros((len(rollouts), longest + 1))
        for index, steps in enumerate(_usable(rollouts)):
            usable[index, : len(steps)] = steps
        variables["usable"] = (dimensions, usable, {"kind": "usable"})
    return xr.Dataset(
        variables,
        coords={
            "rollout": np.arange(len(rollouts)),
            "time": (dimensions, _padded(rollouts.time, np.nan), {"units": "s"}),
        },
        attrs={"time_step": rollouts.time_step},
    )


def from_xarray(dataset: "xr.Dataset") -> Recording:
    """Converts a data set; see :meth:`Rollouts.from_xarray`."""
    for name in ("num_steps", "time"):
        if name not in dataset.variables:
            raise DataError(f"the data set has no variable {name}.")
    lengths = np.asarray(dataset["num_steps"].values)
    if lengths.dtype.kind not in "iu" or not 0 < lengths.size <= LIMITS.rollouts:
        raise DataError(
            f"num_steps should hold up to {LIMITS.rollouts} integers, but it holds "
            f"{lengths.size} of type {lengths.dtype}."
        )
    lengths = lengths.ravel().tolist()
    kinds = ("channel", "action", "reward", "measured", "lateness", "usable")
    columns: dict[str, list[tuple[int, str]]] = {kind: [] for kind in kinds}
    arrays: dict[str, NDArray[np.float64]] = {}
    for name, variable in dataset.variables.items():
        name = str(name)
        kind = str(variable.attrs.get("kind", ""))
        if kind not in columns and name != "time":
            continue
        if variable.dims != ("rollout", "step"):
            raise DataError(
                f"{rollout_checks.shown(name)} has the dimensions "
                f"{rollout_checks.shown(variable.dims)}, not (rollout, step)."
            )
        if variable.dtype.kind not in "fiu":
            raise DataError(
                f"{rollout_checks.shown(name)} is of type {variable.dtype}, not of numbers."
            )
        arrays[name] = np.asarray(variable.values, dtype=np.float64)
        if kind in columns:
            columns[kind].append((int(variable.attrs.get("position", 0)), name))
    size = dataset.sizes.get("step", 0)
    if len(lengths) != dataset.sizes.get("rollout") or any(not 1 <= n < size for n in lengths):
        raise DataError("num_steps does not fit the dimensions rollout and step.")
    names = {kind: [name for _, name in sorted(entries)] for kind, entries in columns.items()}

    def matrices(kind: str, extra: int) -> list[NDArray[np.float64]]:
        stacked = (
            np.stack([arrays[name] for name in names[kind]], axis=-1)
            if names[kind]
            else (np.zeros((len(lengths), size, 0)))
        )
        return [values[: n + extra] for values, n in zip(stacked, lengths, strict=True)]

    units = {name: str(dataset[name].attrs.get("units", "")) for name in arrays}
    rewards = [values[:, 0] for values in matrices("reward", 0)] if names["reward"] else None
    time_step = dataset.attrs.get("time_step")
    recording = Recording.from_arrays(
        matrices("channel", 1),
        matrices("action", 0),
        channel_names=names["channel"],
        action_names=names["action"],
        time_step=None if time_step is None else float(time_step),
        rewards=rewards,
        time=[values[: n + 1] for values, n in zip(arrays["time"], lengths, strict=True)],
        channel_units=[units[name] for name in names["channel"]],
        action_units=[units[name] for name in names["action"]],
    )
    is_sampled = len(names["measured"]) == len(names["lateness"]) == len(names["channel"])
    return _with_sampling(
        recording,
        matrices("measured", 1) if is_sampled else (),
        matrices("lateness", 1) if is_sampled else (),
        [values[:, 0] for values in matrices("usable", 0)] if names["usable"] else (),
    )


def write_netcdf(rollouts: Recording, path: AnyPath) -> None:
    """Writes a NetCDF4 file; see :meth:`Rollouts.to_netcdf`."""
    dataset = to_xarray(rollouts)
    compressed = {str(name): {"zlib": True} for name in dataset.data_vars if name != "num_steps"}
    # HDF5 crashes if the disk is full while it writes to a file.
    content = dataset.to_netcdf(engine="h5netcdf", encoding=compressed)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_netcdf(path: AnyPath) -> Recording:
    """Reads a NetCDF4 file; see :meth:`Rollouts.from_netcdf`."""
    import xarray as xr

    path = rollout_checks.check_file(path)
    with rollout_checks.named(path), rollout_checks.refusing("NetCDF file"):
        # If h5netcdf failed to open it, its half-made object would report a second error when it
        # is deleted.
        check_self_contained(path)
        # Times are seconds without a date, so they must not be decoded with a calendar.
        with xr.open_dataset(
            path, engine="h5netcdf", decode_times=False, decode_timedelta=False
        ) as dataset:
            loaded = dataset.load()
        return from_xarray(loaded)


def _padded(arrays: Sequence[NDArray[np.float64]], padding: float) -> NDArray[np.float64]:
    """Stacks arrays of different lengths, ``(R, longest, …)``."""
    shape = (len(arrays), max(len(values) for values in arrays), *arrays[0].shape[1:])
    result = np.full(shape, padding)
    for index, values in enumerate(arrays):
        result[index, : len(values)] = values
    return result
