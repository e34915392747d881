"""Reads a folder of CSV files that were recorded together, one file per kind of message."""

from pathlib import Path

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.csv_logs import read_csv_columns
from npdr_ppl.rollouts.logs.formats.folders import files_in
from npdr_ppl.rollouts.logs.formats.tables import log_of_columns
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.logs.log_settings import LogSettings
from npdr_ppl.rollouts.notes import Remark

__all__ = ["read_csv_folder"]

MAX_NAMES = 200
"""Largest count of lines of a text file that names joints; humanoids have fifty."""


def read_csv_folder(path: Path, settings: LogSettings) -> Log:
    """Reads every CSV file of a folder; ``arm.csv`` gives the signals ``arm/<column>``.

    A text file with a line for each component of the vectors, such as ``joint_list.txt``, names
    these components: ``arm/positions/shoulder``.

    Args:
        path: The folder.
        settings: How to read the files; all have the same time.

    Raises:
        DataError: A file cannot be read, or none has signals.
    """
    signals: list[Signal] = []
    notes: list[str] = []
    names = _names(path)
    files = files_in(path, ".csv")
    for file in files:
        rollout_checks.check_file(file)
        with rollout_checks.named(file):
            found = read_csv_columns(file, settings.header)
            columns = found.columns
            # A table of events has times, but no numbers.
            numeric = [
                n for n, c in columns.items() if isinstance(c, np.ndarray) or "[" in "".join(c[:5])
            ]
            if len(numeric) < 2:
                notes.append(Remark(f"{file.name} holds no numbers and was left out."))
                continue
            prefix = f"{file.stem}/"
            log = log_of_columns(
                file.name, columns, settings, prefix=prefix, components=names, units=found.units
            )
        signals += log.signals
        notes += [Remark(f"{file.stem}: {note}") for note in found.notes]
        notes += log.notes
        if sum(len(s.values) for s in signals) > LIMITS.numbers:
            raise DataError(f"its files have more than {LIMITS.numbers:.0e} numbers.")
    if not signals:
        raise DataError("no CSV file in it holds numbers.")
    return Log(path.name, tuple(signals), tuple(dict.fromkeys(notes)))


def _names(path: Path) -> list[str]:
    """Returns the lines of the only text file that looks like a list of names."""
    found = []
    for file in files_in(path, ".txt"):
        if not 0 < file.stat().st_size <= LIMITS.text_bytes:
            continue
        text = file.read_bytes().decode("utf-8-sig", errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        if 0 < len(lines) <= MAX_NAMES and len(set(lines)) == len(lines):
            if all(len(line) <= 60 and line.isprintable() for line in lines):
                found.append(lines)
    return found[0] if len(found) == 1 else []
