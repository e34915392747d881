"""Reads CSV files with any columns: any separator, with or without a header."""

import csv
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.io.csv_files import (
    CELLS_PER_BLOCK,
    BoundedLines,
    check_encoding,
    undecodable,
)
from npdr_ppl.rollouts.logs.formats.tables import Texts, log_of_columns, numbers_of
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

__all__ = ["read_csv_columns", "read_csv_log"]

Array = NDArray[np.float64]

SEPARATORS = (",", ";", "\t", "|")

SAMPLE_CHARACTERS = 10_000
"""Length of the beginning of a file, in characters, from which the separator is chosen."""

MAX_TEXT_BYTES = 2**26
"""Largest total of the cells that stay text, in bytes. As text, a cell takes ten times the memory
of a number; vectors of six joints at 50 Hz reach this size after half an hour."""

MAX_WORDS = MAX_TEXT_BYTES // 10
"""Largest number of words or numbers in the cells that stay text. Recorded numbers have about ten
characters, so that their vectors reach ``MAX_TEXT_BYTES`` first."""

_BETWEEN_WORDS = (",", ";", " ")


def read_csv_log(path: Path, settings: LogSettings) -> Log:
    """Reads a CSV file with any columns.

    Args:
        path: The file, UTF-8; cells are separated by commas, semicolons, tabs or bars.
        settings: How to read it.

    Raises:
        DataError: It is not a table of text, or there are no time stamps.
    """
    return log_of_columns(path.name, read_csv_columns(path, settings.header), settings)


def read_csv_columns(path: Path, has_header: bool | None) -> dict[str, Array | Texts]:
    """Returns the columns by name; those in which a cell is no number stay text.

    Args:
        path: The file.
        has_header: Whether the first line names the columns; ``None`` to look whether it holds
            anything but numbers. Without a header, the columns are ``column_0`` and so on.
    """
    data = path.read_bytes()
    check_encoding(data)
    separator = _separator(data)
    lines = BoundedLines(data)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    table = _Table(decimal_comma=separator == ";")
    try:
        for row in reader:
            lines.row_length = 0
            if not row or (len(row) == 1 and not row[0].strip()):
                lines.add_blank(table.num_rows)
                continue
            if not table.names:
                if has_header is None:
                    has_header = not all(numbers_of([cell]) is not None for cell in row)
                table.begin(row if has_header else [f"column_{k}" for k in range(len(row))])
                if has_header:
                    continue
            table.add(row, reader.line_num)
    except csv.Error as error:
        raise DataError(f"line {reader.line_num} is not valid CSV ({error}).") from None
    except UnicodeDecodeError:
        raise DataError(undecodable(data)) from None
    return table.columns()


def _separator(data: bytes) -> str:
    """Returns the separator that occurs equally often in the first lines, outside of quotes."""
    text = data[:SAMPLE_CHARACTERS].decode("utf-8-sig", errors="replace")
    text = re.sub(r'"[^"\n]*"', "", text)
    lines = [line for line in text.splitlines()[:20] if line.strip()]
    if len(lines) > 2 and len(data) > SAMPLE_CHARACTERS:
        lines.pop()  # it may be cut
    counts = {s: [line.count(s) for line in lines] for s in SEPARATORS}
    # A decimal comma makes commas frequent, too, so the other separators come first.
    for separator in (*SEPARATORS[1:], ","):
        if counts[separator] and min(counts[separator]) > 0 and len(set(counts[separator])) == 1:
            return separator
    return max(SEPARATORS, key=lambda s: sum(counts[s])) if lines else ","


class _Table:
    """Columns that grow row by row; blocks of rows become numbers as soon as they are full.

    Attributes:
        names: Names of the columns, empty until :meth:`begin`.
        num_rows: Number of rows so far.
    """

    def __init__(self, *, decimal_comma: bool) -> None:
        self.names: list[str] = []
        self._comma = decimal_comma
        self._rows: list[list[str]] = []
        self._blocks: list[list[Array | Texts]] = []
        self.num_rows = 0
        self._text_bytes = 0
        self._num_words = 0

    def begin(self, header: list[str]) -> None:
        """Takes the names of the columns."""
        names = [cell.strip() for cell in header]
        while len(names) > 1 and not names[-1]:
            names.pop()  # lines that end with a separator
        if len(names) > LIMITS.columns:
            raise DataError(f"it has {len(names)} columns, more than {LIMITS.columns}.")
        for position, name in enumerate(names):
            if position and not name:
                names[position] = f"column_{position}"
        repeated = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if repeated is not None:
            raise DataError(f"the column {rollout_checks.shown(repeated)} appears twice.")
        self.names = names

    def add(self, row: list[str], line: int) -> None:
        """Adds a row; cells at its end may be missing."""
        width = len(self.names)
        if len(row) > width and any(cell.strip() for cell in row[width:]):
            raise DataError(f"line {line} has {len(row)} cells, but the first line has {width}.")
        self._rows.append((row + [""] * (width - len(row)))[:width])
        self.num_rows += 1
        if self.num_rows * width > LIMITS.numbers:
            raise DataError(f"it has more than {LIMITS.numbers:.0e} numbers.")
        if len(self._rows) * width >= CELLS_PER_BLOCK:
            self._convert()

    def columns(self) -> dict[str, Array | Texts]:
        """Returns the columns by name."""
        if not self.names:
            raise DataError("the file has no lines.")
        self._convert()
        result: dict[str, Array | Texts] = {}
        for index, name in enumerate(self.names):
            parts = [block[index] for block in self._blocks]
            if all(isinstance(part, np.ndarray) for part in parts):
                result[name] = np.concatenate(parts) if parts else np.empty(0)
            else:
                result[name] = [cell for part in parts for cell in _as_text(part)]
        return result

    def _convert(self) -> None:
        block: list[Array | Texts] = []
        for index in range(len(self.names)):
            cells = [row[index] for row in self._rows]
            numbers = numbers_of(cells, comma=self._comma)
            if numbers is None:
                self._text_bytes += sum(map(len, cells))
                text = "\n".join(cells)
                self._num_words += len(cells) + max(map(text.count, _BETWEEN_WORDS))
            block.append(cells if numbers is None else numbers)
        if self._text_bytes > MAX_TEXT_BYTES:
            raise DataError(f"its text takes more than {MAX_TEXT_BYTES} bytes.")
        if self._num_words > MAX_WORDS:
            raise DataError(f"its text has more than {MAX_WORDS} words or numbers.")
        self._blocks.append(block)
        self._rows.clear()


def _as_text(part: Array | Texts) -> Texts:
    if isinstance(part, list):
        return part
    return ["" if value != value else repr(value) for value in part.tolist()]
