"""From a log and its mapping to rollouts, in one call."""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.collection import joined
from npdr_ppl.rollouts.gridding import at_one_rate
from npdr_ppl.rollouts.io.file_formats import load
from npdr_ppl.rollouts.io.tables import from_table
from npdr_ppl.rollouts.logs.formats.parquet_logs import columns_of_frame, read_frame_log
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.mapping import Mapping, SignalMapping
from npdr_ppl.rollouts.logs.read import ROS_1_SUFFIX, is_log, read_log
from npdr_ppl.rollouts.logs.signal_names import plain_names
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.recording import Recording

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "is_log",
    "lerobot_mapping",
    "recording_of_frame",
    "recording_of_logs",
]

LEROBOT_UNITS = Remark(
    "LeRobot data sets state no units: values are used as logged, usually degrees or percent; a "
    "mapping converts them."
)
"""What is not known of a data set that is read without a mapping."""

AnyMapping = Mapping | dict[str, Any] | str | PathLike[str] | None


def _without_mapping(path: str | PathLike[str]) -> Recording:
    """Reads a log without a mapping, which only a LeRobot data set can do without."""
    folder = Path(path)
    if (folder / "meta" / "info.json").is_file():
        log = read_log(folder)
        recording = lerobot_mapping(log).apply(log)
        return replace(recording, notes=(*recording.notes, LEROBOT_UNITS))
    if folder.suffix.lower() == ROS_1_SUFFIX:
        read_log(folder)  # raises the error that says how to convert it
    if not folder.is_dir():
        rollout_checks.check_file(folder)
    with rollout_checks.named(path):
        raise DataError(
            "a log needs a mapping that says which signals are channels and actions; run "
            "`npdr inspect LOG --write mapping.toml` to begin one."
        )


def recording_of_logs(paths: Sequence[str | PathLike[str]], mapping: AnyMapping) -> Recording:
    """Reads several logs or files of rollouts, one after another.

    Clocks differ from log to log, and so may rates. All get the time step of the fastest one;
    measurements keep their own times.

    Args:
        paths: The logs.
        mapping: As for :meth:`Rollouts.load`; ``None`` for files of rollouts.

    Raises:
        DataError: There are no logs, one cannot be read, or their columns differ.
    """
    if not paths:
        raise DataError("no files are given; at least one is needed.")
    parts: list[Recording] = []
    chosen = None if mapping is None else Mapping.of(mapping)
    for path in paths:
        if chosen is None and not is_log(path):
            part = load(path)
        elif chosen is None:
            part = _without_mapping(path)
        else:
            part = chosen.apply(read_log(path, chosen.log))
        parts.append(part)
    if len(parts) == 1:
        return parts[0]
    return joined(at_one_rate(parts))


def recording_of_frame(frame: "pd.DataFrame", mapping: AnyMapping) -> Recording:
    """Reads a data frame; see :meth:`Rollouts.from_dataframe`."""
    if mapping is None:
        columns = columns_of_frame(frame)
        for name, values in columns.items():
            if isinstance(values, list) or values.ndim != 1:
                raise DataError(f"{rollout_checks.shown(name)} does not hold numbers.")
        return from_table({n: v for n, v in columns.items() if not isinstance(v, list)}, None)
    chosen = Mapping.of(mapping)
    return chosen.apply(read_frame_log(frame, chosen.log))


def lerobot_mapping(log: Log) -> Mapping:
    """Returns the mapping of a LeRobot data set: its states are channels, its actions actions.

    Raises:
        DataError: The data set has no ``observation.state``.
    """
    states = [n for n in log.by_name if n.startswith("observation.state")]
    actions = [n for n in log.by_name if n == "action" or n.startswith("action.")]
    if not states:
        with rollout_checks.named(log.source):
            raise DataError(
                "it has no observation.state; run `npdr inspect LOG --write mapping.toml` and "
                "choose its channels."
            )
    names = plain_names([*states, *actions])
    entries = {n: SignalMapping(s) for n, s in zip(names, [*states, *actions], strict=True)}
    keys = list(entries)
    return Mapping(
        log=msgspec.structs.replace(Mapping().log, episodes=log.episodes or None),
        channels={n: entries[n] for n in keys[: len(states)]},
        actions={n: entries[n] for n in keys[len(states) :]},
    )
