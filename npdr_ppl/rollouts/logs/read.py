"""Reads a log of any known format, chosen by its suffix or by what a folder contains."""

from collections.abc import Callable
from itertools import islice
from os import PathLike
from pathlib import Path

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

__all__ = ["LOG_SUFFIXES", "is_log", "read_log"]

LOG_SUFFIXES = (".csv", ".tsv", ".txt", ".parquet", ".h5", ".hdf5", ".mat", ".mcap", ".db3")
"""Suffixes of the files that can be read as logs."""

ROS_1_SUFFIX = ".bag"
"""Suffix of logs that have to be converted first."""

Reader = Callable[[Path, LogSettings], Log]


def is_log(path: str | PathLike[str]) -> bool:
    """Returns whether a path has a format that only logs have; tables may be rollouts, too."""
    path = Path(path)
    if path.is_dir():
        return (path / "meta" / "info.json").is_file() or _is_bag(path)
    suffix = path.suffix.lower()
    return suffix in (*LOG_SUFFIXES, ROS_1_SUFFIX) and suffix not in (".csv", ".parquet")


def _is_bag(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file() or bool(_suffixes(folder) & {".db3", ".mcap"})


def _suffixes(folder: Path) -> set[str]:
    """Returns the suffixes of the first files of a folder."""
    return {file.suffix.lower() for file in islice(folder.iterdir(), LIMITS.parts)}


def read_log(path: str | PathLike[str], settings: LogSettings | None = None) -> Log:
    """Reads a log.

    ======================================  ===============================================
    ``.csv``, ``.tsv``, ``.txt``            a table of any columns
    ``.parquet``                            a table of any columns
    ``.h5``, ``.hdf5``                      data sets, with one of time stamps
    ``.mat``                                MATLAB, version 5 to 7.3
    ``.mcap``, ``.db3``                     messages of ROS 2, or JSON
    a folder with ``metadata.yaml``         a bag of ROS 2
    a folder with ``meta/info.json``        a LeRobot data set, version 2.1 or 3.0
    a folder with ``.csv`` files            tables that were recorded together
    ======================================  ===============================================

    Args:
        path: The file or folder.
        settings: How to read it; by default everything is guessed.

    Raises:
        DataError: It cannot be read; the message says why in one sentence.
        DependencyError: The format needs a package that is not installed.
    """
    path = Path(path)
    settings = settings or LogSettings()
    if not path.is_dir():
        rollout_checks.check_file(path)
    with rollout_checks.named(path):
        reader, kind = _reader(path)
        with rollout_checks.refusing(f"{kind} log"):
            log = reader(path, settings)
        if not log.signals:
            raise DataError("it has no signals.")
        if len(log.by_name) < len(log.signals):
            raise DataError("two of its signals have the same name.")
        return log


def _reader(path: Path) -> tuple[Reader, str]:
    """Returns the function that reads a path, and a word for its format."""
    from npdr_ppl.rollouts.logs.formats.bag_logs import (
        read_bag_folder,
        read_db3_log,
        read_mcap_log,
    )
    from npdr_ppl.rollouts.logs.formats.csv_folders import read_csv_folder
    from npdr_ppl.rollouts.logs.formats.csv_logs import read_csv_log
    from npdr_ppl.rollouts.logs.formats.hdf5_logs import read_hdf5_log
    from npdr_ppl.rollouts.logs.formats.lerobot import read_lerobot
    from npdr_ppl.rollouts.logs.formats.mat_logs import read_mat_log
    from npdr_ppl.rollouts.logs.formats.parquet_logs import read_parquet_log

    by_suffix: dict[str, tuple[Reader, str]] = {
        ".csv": (read_csv_log, "CSV"),
        ".tsv": (read_csv_log, "CSV"),
        ".txt": (read_csv_log, "CSV"),
        ".parquet": (read_parquet_log, "Parquet"),
        ".h5": (read_hdf5_log, "HDF5"),
        ".hdf5": (read_hdf5_log, "HDF5"),
        ".mat": (read_mat_log, "MAT"),
        ".mcap": (read_mcap_log, "MCAP"),
        ".db3": (read_db3_log, "ROS bag"),
    }
    if path.is_dir():
        if (path / "meta" / "info.json").is_file():
            return read_lerobot, "LeRobot"
        if _is_bag(path):
            return read_bag_folder, "ROS bag"
        if ".csv" in _suffixes(path):
            return read_csv_folder, "CSV"
        raise DataError(
            "the folder is neither a ROS 2 bag, nor a LeRobot data set, nor are there CSV files "
            "in it."
        )
    suffix = path.suffix.lower()
    if suffix == ROS_1_SUFFIX:
        raise DataError(
            "a bag of ROS 1 is not read; convert it with `rosbags-convert --src FILE.bag --dst "
            "FOLDER` (pip install rosbags) and read the folder."
        )
    if suffix not in by_suffix:
        raise DataError(
            f"the suffix {rollout_checks.shown(suffix)} is unknown; logs are folders or "
            f"{', '.join(by_suffix)} files."
        )
    return by_suffix[suffix]
