"""CSV files: a strict reader that reports each error precisely, and an exact writer."""

import csv
import io
import math
import re
from collections.abc import Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.io.tables import from_table, to_table
from npdr_ppl.rollouts.recording import Recording

__all__ = ["read_csv", "write_csv"]

# float() also accepts underscores, digits of other scripts and "nan", which are mistakes here.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NUMBER_CHARACTERS = frozenset("0123456789+-.eE")

_UNIT_IN_NAME = re.compile(r"\s*[\[(].*[\])]$")

NOT_A_NUMBER = frozenset({"nan", "na", "n/a", "null", "none"})
"""Words that programs write for a missing measurement, in lower case."""

GAP = (
    "; interpolate single missing values, and cut the rollout in two at longer gaps (the "
    "actions of a rollout's last row stay empty)"
)
"""End of the message about a missing measurement: what to do."""


def read_csv(path: str | PathLike[str], actions: Sequence[str] | None) -> Recording:
    """Reads rollouts; see :meth:`Rollouts.from_csv`."""
    path = rollout_checks.check_file(path)
    with rollout_checks.named(path):
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DataError(f"cannot be read ({error.strerror}).") from None
        header, rows, lines = _parse(_decode(data))
        columns = {}
        for index, name in enumerate(header):
            columns[name] = _numbers(name, [row[index] for row in rows], lines)
        return from_table(columns, actions, lines=lines)


def write_csv(rollouts: Recording, path: str | PathLike[str]) -> None:
    """Writes rollouts; see :meth:`Rollouts.to_csv`."""
    columns = to_table(rollouts)
    cells = [
        ["" if value != value else repr(value) for value in column.tolist()]
        for column in columns.values()
    ]
    rows = map(",".join, zip(*cells, strict=True))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        file.write("\n".join([",".join(columns), *rows, ""]))


def _decode(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError("the text is encoded as UTF-16, but UTF-8 is needed.")
    if b"\0" in data:
        raise DataError("the file contains NUL bytes, so it is not a text file.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DataError(
            f"line {line} is not UTF-8 text (byte 0x{data[error.start]:02x})."
        ) from None


def _parse(text: str) -> tuple[list[str], list[list[str]], list[int]]:
    """Returns the header, the rows that are not blank, and each row's line number."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header: list[str] | None = None
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in reader:
            if not row or (len(row) == 1 and not row[0].strip()):
                continue
            if header is None:
                header = _checked_header(row)
                continue
            if len(row) != len(header):
                raise DataError(
                    f"line {reader.line_num} has {len(row)} cells, but the header has "
                    f"{len(header)}."
                )
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise DataError(f"line {reader.line_num} is not valid CSV ({error}).") from None
    if header is None:
        raise DataError("the file has no header line.")
    return header, rows, lines


def _checked_header(row: list[str]) -> list[str]:
    header = [cell.strip() for cell in row]
    if len(header) == 1:
        for separator, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if separator in header[0]:
                raise DataError(f"cells are separated by {word}, but commas are needed.")
    if all(_NUMBER.fullmatch(cell) for cell in header):
        raise DataError("the first line holds numbers, but it should name the columns.")
    rollout_checks.check_names(header, "column")
    for required in ("rollout", "time"):
        if required not in header:
            told = [n for n in header if _UNIT_IN_NAME.sub("", n) == required]
            hint = f"; units are SI and no part of names, so rename {told[0]!r}" if told else ""
            raise DataError(
                f"there is no column {required}; the header is "
                f"{rollout_checks.shown(','.join(header))}{hint}."
            )
    return header


def _numbers(name: str, cells: list[str], lines: list[int]) -> NDArray[np.float64]:
    """Converts a column, NaN for empty cells."""
    cells = [cell.strip() for cell in cells]
    if _NUMBER_CHARACTERS.issuperset("".join(cells)):
        try:
            values = np.array([float(cell) if cell else math.nan for cell in cells])
        except ValueError:
            pass  # the loop below finds the wrong cell
        else:
            is_infinite = np.isinf(values)
            if not is_infinite.any():
                return values
            row = int(np.argmax(is_infinite))
            raise DataError(f"{name} is too large in line {lines[row]}.")
    for cell, line in zip(cells, lines, strict=True):
        if cell and not _NUMBER.fullmatch(cell):
            raise DataError(
                f"{name} is {rollout_checks.shown(cell)} in line {line}, "
                "which is not a finite number"
                f"{GAP if cell.lower() in NOT_A_NUMBER else ''}."
            )
    raise DataError(f"{name} has a cell that is not a finite number.")
