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
from contextlib import suppress
from typing import IO, Any

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts.rollout_checks import check_names, shown

__all__ = ["check_footer", "check_parquet"]

_MARK = b"PAR1"

_GROUPS, _COLUMNS, _METADATA = 4, 1, 3
"""Fields of the footer, of a row group and of a column."""

_COMPRESSED, _DATA_OFFSET, _DICTIONARY_OFFSET = 7, 9, 11
"""Fields of a column's metadata."""

_PAGE_DECOMPRESSED, _PAGE_COMPRESSED = 2, 3
"""Fields of a page's header."""

HEADER_BYTES = 2**16
"""Longest page header that is read, in bytes."""

USUAL_HEADER_BYTES = 2**9
"""Bytes of a page header that are read at first; with statistics of numbers it has about 100."""


def check_footer(file: IO[bytes]) -> None:
    """Checks the footer and the pages before the library opens the file.

    Raises:
        DataError: The footer is longer than that of any recording, or the pages decompress to too
            many bytes.
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
    total = 0.0
    for group in footer[_GROUPS]:
        for column in group[_COLUMNS]:
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
