"""CSV files: a strict reader that reports each error precisely, and an exact writer."""

import csv
import io
import math
import re
from array import array
from collections.abc import Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.atomic_files import replacing
from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.io.tables import READ_AS_LOG, from_table, to_table
from npdr_ppl.rollouts.recording import Recording

__all__ = ["BoundedLines", "check_encoding", "read_csv", "undecodable", "write_csv"]

# float() also accepts underscores, digits of other scripts and "nan", which are mistakes here.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NUMBER_CHARACTERS = frozenset("0123456789+-.eE")

_UNIT_IN_NAME = re.compile(r"\s*[\[(].*[\])]$")

CELLS_PER_BLOCK = 100_000
"""Number of cells that are kept as text before they are converted; they take about 7 MB."""

NOT_A_NUMBER = frozenset({"nan", "na", "n/a", "null", "none", "-"})
"""Words that programs write for a missing measurement, in lower case."""


def read_csv(path: str | PathLike[str], actions: Sequence[str] | None) -> Recording:
    """Reads rollouts; see :meth:`Rollouts.from_csv`."""
    path = rollout_checks.check_file(path)
    with rollout_checks.named(path):
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DataError(f"cannot be read ({error.strerror}).") from None
        check_encoding(data)
        columns, lines = _parse(data)
        return from_table(columns, actions, lines=lines)


def write_csv(rollouts: Recording, path: str | PathLike[str]) -> None:
    """Writes rollouts; see :meth:`Rollouts.to_csv`."""
    columns = to_table(rollouts)
    cells = [
        ["" if value != value else _cell(name, value) for value in column.tolist()]
        for name, column in columns.items()
    ]
    rows = map(",".join, zip(*cells, strict=True))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        file.write("\n".join([",".join(columns), *rows, ""]))


def _cell(name: str, value: float) -> str:
    """Returns a number as text; rollouts and steps are counted."""
    return f"{value:.0f}" if name in ("rollout", "step") else repr(value)


def check_encoding(data: bytes) -> None:
    """Raises a DataError if a text file is visibly not UTF-8."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError("the text is encoded as UTF-16, but UTF-8 is needed.")
    if b"\0" in data:
        raise DataError("the file contains NUL bytes, so it is not a text file.")


def _parse(data: bytes) -> tuple[dict[str, NDArray[np.float64]], "array[int]"]:
    """Returns the columns by name, and the line number of each row that is not blank.

    Cells are converted in blocks of rows, because as text they take several times the memory.
    """
    source = BoundedLines(data)
    reader = csv.reader(source, strict=True)
    header: list[str] = []
    rows: list[list[str]] = []
    lines = array("q")
    blocks: list[list[NDArray[np.float64]]] = []
    rollouts = _RolloutCount()

    def convert() -> None:
        numbers = lines[len(lines) - len(rows) :]
        cells = [[row[index] for row in rows] for index in range(len(header))]
        columns = zip(header, cells, strict=True)
        blocks.append([_numbers(name, column, numbers) for name, column in columns])
        rollouts.add(blocks[-1][header.index("rollout")])
        rows.clear()

    try:
        for row in reader:
            source.row_length = 0
            if not row or (len(row) == 1 and not row[0].strip()):
                source.add_blank(len(lines))
                continue
            if not header:
                header = _checked_header(row)
                continue
            if len(row) != len(header):
                raise DataError(
                    f"line {reader.line_num} has {len(row)} cells, but the header has "
                    f"{len(header)}."
                )
            rows.append(row)
            lines.append(reader.line_num)
            if len(lines) * len(header) > LIMITS.numbers:
                raise DataError(f"it has more than {LIMITS.numbers:.0e} numbers.")
            if len(rows) * len(header) >= CELLS_PER_BLOCK:
                convert()
    except csv.Error as error:
        raise DataError(f"line {reader.line_num} is not valid CSV ({error}).") from None
    except UnicodeDecodeError:
        raise DataError(undecodable(data)) from None
    if not header:
        raise DataError("the file has no header line.")
    convert()
    return {
        name: np.concatenate(parts) for name, *parts in zip(header, *blocks, strict=True)
    }, lines


class _RolloutCount:
    """Counts rollouts block by block, so that a file with too many is not read to its end."""

    def __init__(self) -> None:
        self._number = 1
        self._last = np.empty(0)

    def add(self, values: NDArray[np.float64]) -> None:
        """Takes the next values of the column rollout; raises a DataError if they are too many.

        A change to or from an empty cell does not count; it gets a message of its own later.
        """
        self._number += int((np.abs(np.diff(values, prepend=self._last)) > 0).sum())
        self._last = values[-1:]
        if self._number > LIMITS.rollouts:
            raise DataError(f"it has more than {LIMITS.rollouts} rollouts.")


class BoundedLines:
    """The lines of a text, decoded block by block; no row may be longer than a limit.

    Args:
        data: The text.
        encoding: How it is encoded.

    Attributes:
        number: Number of the present line, from 1.
        row_length: Characters since the last row ended; a quoted cell may hold several lines.
        num_blank: Number of blank lines so far.
    """

    def __init__(self, data: bytes, encoding: str = "utf-8-sig") -> None:
        self._file = io.TextIOWrapper(io.BytesIO(data), encoding=encoding, newline="")
        self.number = 0
        self.row_length = 0
        self.num_blank = 0

    def add_blank(self, num_rows: int) -> None:
        """Counts a blank line; raises a DataError if there are many more of them than rows."""
        self.num_blank += 1
        if self.num_blank > num_rows + LIMITS.blank_lines:
            raise DataError(f"it has {LIMITS.blank_lines} more blank lines than rows.")

    def __iter__(self) -> "BoundedLines":
        return self

    def __next__(self) -> str:
        line = self._file.readline(LIMITS.line_length + 1)
        if not line:
            raise StopIteration
        self.number += 1
        self.row_length += len(line)
        if self.row_length > LIMITS.line_length:
            raise DataError(
                f"the row in line {self.number} has more than {LIMITS.line_length} characters."
            )
        return line


def undecodable(data: bytes) -> str:
    """Returns a sentence about the first byte that is not UTF-8."""
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        return f"line {line} is not UTF-8 text (byte 0x{data[error.start]:02x})."
    return "the file is not UTF-8 text."


def _checked_header(row: list[str]) -> list[str]:
    header = [cell.strip() for cell in row]
    if len(header) == 1:
        for separator, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if separator in header[0]:
                raise DataError(
                    f"cells are separated by {word}, but commas are needed{READ_AS_LOG}."
                )
    if all(_NUMBER.fullmatch(cell) for cell in header):
        raise DataError(
            "the first line holds numbers, but it should name the columns" + READ_AS_LOG + "."
        )
    if len(header) > LIMITS.columns:
        raise DataError(f"it has {len(header)} columns, more than {LIMITS.columns}.")
    for required in ("rollout", "time"):
        if required not in header:
            told = [n for n in header if _UNIT_IN_NAME.sub("", n) == required]
            hint = (
                f"; units are SI and no part of names, so rename {told[0]!r}"
                if told
                else READ_AS_LOG
            )
            raise DataError(
                f"there is no column {required}; the header is "
                f"{rollout_checks.shown(','.join(header))}{hint}."
            )
    rollout_checks.check_names(header)
    return header


def _numbers(name: str, cells: list[str], lines: Sequence[int]) -> NDArray[np.float64]:
    """Converts a column, NaN for empty cells."""
    cells = [cell.strip() for cell in cells]
    cells = ["" if cell.lower() in NOT_A_NUMBER else cell for cell in cells]
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
                "which is not a finite number."
            )
    raise DataError(f"{name} has a cell that is not a finite number.")
