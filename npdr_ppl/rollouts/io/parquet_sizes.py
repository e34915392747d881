"""Checks how much memory a Parquet file needs, from its footer and the headers of its pages.

The footer states the number of rows and columns. The header of a page states its size after
decompression. The decompressor does not check this size, so these headers are read as well. Both
are Thrift structures in the compact protocol. They are read here because the library ends the
whole process where a footer contradicts itself.

References:
    Apache Parquet, parquet.thrift, ``FileMetaData`` and ``PageHeader``; Apache Thrift, compact
    protocol specification.
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts.rollout_checks import check_names, shown

__all__ = ["check_footer", "check_parquet"]

_MARK = b"PAR1"

_GROUPS, _COLUMNS, _METADATA = 4, 1, 3
"""Fields of the footer, of a row group and of a column."""

_ENCRYPTED = (8, 9)
"""Fields of a column that only an encrypted one has."""

_COMPRESSED, _DATA_OFFSET, _DICTIONARY_OFFSET, _SIZES = 7, 9, 11, 16
"""Fields of a column's metadata."""

_TEXT_BYTES, _REPETITION_LEVELS, _DEFINITION_LEVELS = 1, 2, 3
"""Fields of a column's size statistics: bytes of its texts, and a count of each level."""

_SCHEMA, _TYPE, _REPETITION, _NUM_CHILDREN = 2, 1, 3, 5
"""Fields of the footer and of an element of its schema."""

_OPTIONAL, _REPEATED, _TEXT = 1, 2, 6
"""Repetitions of an element of the schema, and the type of texts."""

_PAGE_DECOMPRESSED, _PAGE_COMPRESSED = 2, 3
"""Fields of a page's header."""

HEADER_BYTES = 2**16
"""Longest page header that is read, in bytes."""

USUAL_HEADER_BYTES = 2**9
"""Bytes of a page header that are read at first; with statistics of numbers it has about 100."""


def check_footer(file: IO[bytes]) -> None:
    """Checks the footer and the pages before the library opens the file.

    Raises:
        DataError: The footer is longer than that of any recording or contradicts itself, the file
            is encrypted, or the pages decompress to too many bytes.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 8))
    length, mark = int.from_bytes(file.read(4), "little"), file.read(4)
    if mark != _MARK or length + 8 > size:
        raise DataError("it does not end as a Parquet file does.")
    if length > LIMITS.text_bytes:
        raise DataError(f"its description takes {length} bytes, more than {LIMITS.text_bytes}.")
    file.seek(size - 8 - length)
    footer = _Compact(file.read(length)).structure()
    leaves = _leaves(footer[_SCHEMA])
    total = 0.0
    for group in footer[_GROUPS]:
        for column, leaf in zip(group[_COLUMNS], leaves, strict=True):
            if any(field in column for field in _ENCRYPTED):
                raise DataError("it is encrypted.")
            leaf.check(column[_METADATA].get(_SIZES, {}))
            total += _page_bytes(file, column[_METADATA])
            check_expansion(total, size)
    file.seek(0)


def check_parquet(parquet: Any, size: int) -> None:
    """Checks that all columns are numbers, and how much memory they need.

    Args:
        parquet: The open ``pyarrow.parquet.ParquetFile``.
        size: Bytes of the file.

    Raises:
        DataError: A column does not hold numbers, or the table is too large.
    """
    import pyarrow as pa

    schema, metadata = parquet.schema_arrow, parquet.metadata
    if len(schema) > LIMITS.columns or metadata.num_columns > LIMITS.columns:
        raise DataError(f"it has {len(schema)} columns, more than {LIMITS.columns}.")
    check_names(schema.names)
    for field in schema:
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            raise DataError(
                f"{field.name} is of type {shown(str(field.type))}, but numbers are needed."
            )
    check_expansion(8.0 * metadata.num_rows * metadata.num_columns, size)


@dataclass(frozen=True)
class _Leaf:
    """A column as the schema describes it.

    Attributes:
        is_text: Whether it holds texts.
        repetition: Largest repetition level.
        definition: Largest definition level.
    """

    is_text: bool
    repetition: int
    definition: int

    def check(self, sizes: dict[int, Any]) -> None:
        """Checks size statistics, which the library takes for those of this column.

        Raises:
            DataError: They are those of another kind of column.
        """
        levels = (_REPETITION_LEVELS, self.repetition), (_DEFINITION_LEVELS, self.definition)
        fits = all(len(sizes.get(field) or ()) in (0, most + 1) for field, most in levels)
        if not fits or (_TEXT_BYTES in sizes and not self.is_text):
            raise DataError("the statistics of a column contradict its type.")


def _leaves(schema: Sequence[dict[int, Any]]) -> list[_Leaf]:
    """Returns the columns of a schema, whose elements are listed depth first, the root first."""
    leaves: list[_Leaf] = []
    # Children that are still to come, and the levels of their parent, from the root down.
    waiting = [[schema[0].get(_NUM_CHILDREN, 0), 0, 0]]
    for element in schema[1:]:
        while waiting and not waiting[-1][0]:
            waiting.pop()
        if not waiting:
            raise DataError("its schema contradicts itself.")
        waiting[-1][0] -= 1
        _, repetition, definition = waiting[-1]
        kind = element.get(_REPETITION)
        repetition += kind == _REPEATED
        definition += kind in (_OPTIONAL, _REPEATED)
        if element.get(_NUM_CHILDREN):
            waiting.append([element[_NUM_CHILDREN], repetition, definition])
        else:
            leaves.append(_Leaf(element.get(_TYPE) == _TEXT, repetition, definition))
    return leaves


def _page_bytes(file: IO[bytes], column: dict[int, Any]) -> float:
    """Returns the decompressed bytes of a column's pages, as their headers state them."""
    position = min(column[_DATA_OFFSET], column.get(_DICTIONARY_OFFSET) or column[_DATA_OFFSET])
    end = position + column[_COMPRESSED]
    total = 0.0
    while position < end:
        header, fields = _page_header(file, position)
        decompressed, compressed = fields[_PAGE_DECOMPRESSED], fields[_PAGE_COMPRESSED]
        if decompressed < 0 or compressed < 0:
            raise DataError("a page has a negative size.")
        total += decompressed
        position += header.position + compressed
    return total


def _page_header(file: IO[bytes], position: int) -> tuple["_Compact", dict[int, Any]]:
    """Returns the header of a page, and its fields."""
    for length in (USUAL_HEADER_BYTES, HEADER_BYTES):
        file.seek(position)
        header = _Compact(file.read(length))
        # Text that is skipped may end behind the bytes, so the position is compared, too.
        with suppress(IndexError):
            fields = header.structure()
            if header.position <= len(header.data):
                return header, fields
    raise DataError("a page has no header, or one that is too long.")


class _Compact:
    """A structure in Thrift's compact protocol.

    Attributes:
        position: Bytes read so far.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0

    def structure(self, depth: int = 0) -> dict[int, Any]:
        """Reads a structure; returns its numbers, lists and structures by number of the field."""
        if depth > LIMITS.depth:
            raise ValueError("nested too deeply")
        found: dict[int, Any] = {}
        identifier = 0
        data = self.data
        while kind := data[self.position]:
            self.position += 1
            identifier = identifier + (kind >> 4) if kind >> 4 else self._number()
            found[identifier] = self._value(kind & 15, depth)
        self.position += 1
        return found

    def _byte(self) -> int:
        self.position += 1
        return self.data[self.position - 1]

    def _length(self) -> int:
        # A footer has many thousands of lengths, so their bytes are read in one loop.
        data, position = self.data, self.position
        result = shift = 0
        while (byte := data[position]) & 128:
            position += 1
            result |= (byte & 127) << shift
            shift += 7
            if shift > 63:  # adding up a longer one takes time that grows with its square
                raise ValueError("a number has more than 64 bits")
        self.position = position + 1
        return result | byte << shift

    def _number(self) -> int:
        value = self._length()
        return (value >> 1) ^ -(value & 1)

    def _value(self, kind: int, depth: int) -> Any:
        if 4 <= kind <= 6:
            value = self._length()
            return (value >> 1) ^ -(value & 1)
        # Text, truth values, bytes and floating-point numbers are not needed.
        if kind == 8:
            length = self._length()
            self.position += length
            return None
        if kind in (9, 10):
            head = self._byte()
            length = head >> 4 if head >> 4 < 15 else self._length()
            entry = head & 15 if head & 15 > 2 else 3  # in a list, a truth value takes a byte
            return [self._value(entry, depth + 1) for _ in range(length)]
        if kind == 12:
            return self.structure(depth + 1)
        if kind not in (1, 2, 3, 7):
            raise ValueError("not a structure of a Parquet file")
        self.position += {3: 1, 7: 8}.get(kind, 0)
        return None
