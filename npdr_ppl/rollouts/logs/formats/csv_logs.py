"""Reads CSV files with any columns: any separator, with or without a header."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
from npdr_ppl.rollouts.logs.units import is_known
from npdr_ppl.rollouts.notes import Remark

__all__ = ["CsvColumns", "read_csv_columns", "read_csv_log"]

Array = NDArray[np.float64]

SEPARATORS = (";", "\t", "|", ",", " ")
"""Separators of cells, tried in this order: a decimal comma makes commas frequent. Several spaces
are one separator."""

SAMPLE_CHARACTERS = 10_000
"""Length of the beginning of a file, in characters, from which the separator is chosen."""

MAX_TEXT_BYTES = 2**26
"""Largest total of the cells that stay text, in bytes. As text, a cell takes ten times the memory
of a number; vectors of six joints at 50 Hz reach this size after half an hour."""

MAX_WORDS = MAX_TEXT_BYTES // 10
"""Largest number of words or numbers in the cells that stay text. Recorded numbers have about ten
characters, so that their vectors reach ``MAX_TEXT_BYTES`` first."""

MAX_UNIT = 30
"""Largest length of a unit in characters."""

_NOT_LATIN_1 = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f-\x9f]")
"""Control characters, which no text in Latin-1 has."""

_SPACE_BEFORE_UNIT = re.compile(r" (?=[\[(][^\W\d_][^\s\[\]()]*[\])])")

_BETWEEN_WORDS = (",", ";", " ")


@dataclass(frozen=True)
class CsvColumns:
    """The columns of a CSV file.

    Attributes:
        columns: The columns by name; those in which a cell is no number stay text.
        units: Units by column, from the row below the header; empty without such a row.
        notes: What was guessed, a sentence each.
    """

    columns: dict[str, Array | Texts]
    units: dict[str, str]
    notes: tuple[Remark, ...]


def read_csv_log(path: Path, settings: LogSettings) -> Log:
    """Reads a CSV file with any columns.

    Args:
        path: The file, UTF-8 or Latin-1; cells are separated by commas, semicolons, tabs, bars or
            spaces. Lines that begin with ``#`` are comments. Units may be in a row below the
            header.
        settings: How to read it.

    Raises:
        DataError: It is not a table of text, or there are no time stamps.
    """
    found = read_csv_columns(path, settings.header)
    log = log_of_columns(path.name, found.columns, settings, units=found.units)
    return replace(log, notes=(*found.notes, *log.notes))


def read_csv_columns(path: Path, has_header: bool | None) -> CsvColumns:
    """Returns the columns of a CSV file.

    Args:
        path: The file.
        has_header: Whether the first line names the columns; ``None`` to look whether it holds
            anything but numbers. Without a header, the columns are ``column_0`` and so on.
    """
    data = path.read_bytes()
    check_encoding(data)
    try:
        return _parsed(data, has_header, "utf-8-sig")
    except UnicodeDecodeError:
        if _NOT_LATIN_1.search(data):
            raise DataError(undecodable(data)) from None
    found = _parsed(data, has_header, "latin-1")
    return replace(found, notes=(Remark("the text is not UTF-8; taken as Latin-1."), *found.notes))


def _parsed(data: bytes, has_header: bool | None, encoding: str) -> CsvColumns:
    """Returns the columns of a text.

    Raises:
        DataError: It is not a table.
        UnicodeDecodeError: It has another encoding.
    """
    separator = _separator(data)
    lines = BoundedLines(data, encoding)
    rows: Iterator[str] = map(_with_single_spaces, lines) if separator == " " else lines
    reader = csv.reader(rows, delimiter=separator, skipinitialspace=True)
    table = _Table(decimal_comma=separator in (";", " "))
    comment: list[str] = []
    notes: list[Remark] = []
    try:
        for row in reader:
            lines.row_length = 0
            if not row or (len(row) == 1 and not row[0].strip()):
                lines.add_blank(table.num_rows)
                continue
            if row[0].startswith("#"):
                lines.add_blank(table.num_rows)
                if not table.names:
                    row[0] = row[0].lstrip("# ")
                    comment = row if row[0] else row[1:]
                continue
            if not table.names:
                is_numeric = all(numbers_of([c], comma=table.comma) is not None for c in row)
                if has_header is not False and is_numeric and len(comment) == len(row):
                    table.begin(comment)  # as numpy.savetxt writes it
                    notes.append(Remark("the last comment above the numbers names the columns."))
                else:
                    is_header = has_header is True or (has_header is None and not is_numeric)
                    table.begin(row if is_header else [f"column_{k}" for k in range(len(row))])
                    if is_header:
                        continue
            elif not table.num_rows and not table.units and _are_units(row):
                table.set_units(row)
                notes.append(Remark("the row below the header has the units."))
                continue
            table.add(row, reader.line_num)
    except csv.Error as error:
        raise DataError(f"line {reader.line_num} is not valid CSV ({error}).") from None
    return CsvColumns(table.columns(), table.units, tuple(notes))


def _with_single_spaces(line: str) -> str:
    """Returns a line without spaces at its ends, several in a row, or before ``[unit]``."""
    return _SPACE_BEFORE_UNIT.sub("", " ".join(line.split()))


def _are_units(row: list[str]) -> bool:
    """Returns whether the cells of a row are units, most of them known; some may be empty."""
    cells = [cell for cell in map(_bare_unit, row) if cell]
    is_data = [numbers_of([c]) is not None or bool(re.search(r"\d\d", c)) for c in cells]
    if any(is_data) or any(len(cell) > MAX_UNIT for cell in cells):
        return False
    num_known = sum(is_known(cell) for cell in cells)
    return 2 * num_known > len(cells)


def _bare_unit(cell: str) -> str:
    """Returns a unit without brackets around it."""
    cell = cell.strip()
    if cell[:1] + cell[-1:] in ("[]", "()"):
        cell = cell[1:-1].strip()
    return "" if cell == "-" else cell


def _separator(data: bytes) -> str:
    """Returns the separator that occurs equally often in the first lines, outside of quotes."""
    text = data[:SAMPLE_CHARACTERS].decode("utf-8-sig", errors="replace")
    text = re.sub(r'"[^"\n]*"', "", text)
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) > 2 and len(data) > SAMPLE_CHARACTERS:
        lines.pop()  # it may be cut
    lines = [line for line in lines if not line.startswith("#")][:20] or lines[:20]
    for separator in SEPARATORS:
        counts = [_count(line, separator) for line in lines]
        if counts and min(counts) > 0 and len(set(counts)) == 1:
            return separator
    return max((",", ";", "\t", "|"), key=lambda s: sum(_count(line, s) for line in lines))


def _count(line: str, separator: str) -> int:
    return (_with_single_spaces(line) if separator == " " else line).count(separator)


class _Table:
    """Columns that grow row by row; blocks of rows become numbers as soon as they are full.

    Attributes:
        comma: Whether decimals may be written with a comma.
        names: Names of the columns, empty until :meth:`begin`.
        units: Units by column, empty until :meth:`set_units`.
        num_rows: Number of rows so far.
    """

    def __init__(self, *, decimal_comma: bool) -> None:
        self.names: list[str] = []
        self.units: dict[str, str] = {}
        self.comma = decimal_comma
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

    def set_units(self, row: list[str]) -> None:
        """Takes the units of the columns."""
        units = map(_bare_unit, row)
        self.units = {name: u for name, u in zip(self.names, units, strict=False) if u}

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
            numbers = numbers_of(cells, comma=self.comma)
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
