"""Checks how much memory a Parquet file needs, from its footer and the headers of its pages.

The footer states the number of rows and columns. The header of a page states its size after
decompression. The decompressor does not check this size, so these headers are read as well. They
are Thrift structures in the compact protocol. Only their first three numbers are needed.

References:
    Apache Parquet, parquet.thrift, ``PageHeader``; Apache Thrift, compact protocol specification.
"""

import os
from typing import IO, Any

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts.rollout_checks import check_names, shown

__all__ = ["check_footer", "check_parquet"]

HEADER_BYTES = 2**16
"""Longest page header that is read, in bytes; statistics of numbers take less than a hundred."""


def check_footer(file: IO[bytes]) -> None:
    """Checks the length of the footer, which is parsed as a whole when the file is opened.

    Raises:
        DataError: It is longer than any footer of a recording.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 8))
    length, mark = int.from_bytes(file.read(4), "little"), file.read(4)
    if mark == b"PAR1" and length > LIMITS.text_bytes:
        raise DataError(f"its description takes {length} bytes, more than {LIMITS.text_bytes}.")
    file.seek(0)


def check_parquet(parquet: Any, file: IO[bytes]) -> None:
    """Checks that all columns are numbers, and how much memory they need.

    Args:
        parquet: The open ``pyarrow.parquet.ParquetFile``.
        file: The same file.

    Raises:
        DataError: A column does not hold numbers, or the table is too large.
    """
    import pyarrow as pa

    schema, metadata = parquet.schema_arrow, parquet.metadata
    if len(schema) > LIMITS.columns or metadata.num_columns > LIMITS.columns:
        raise DataError(f"it has {len(schema)} columns, more than {LIMITS.columns}.")
    check_names(schema.names, "column")
    for field in schema:
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            raise DataError(
                f"{field.name} is of type {shown(str(field.type))}, but numbers are needed."
            )
    size = os.fstat(file.fileno()).st_size
    check_expansion(8.0 * metadata.num_rows * metadata.num_columns, size)
    rows = pages = 0.0
    for group in (metadata.row_group(index) for index in range(metadata.num_row_groups)):
        rows += group.num_rows
        for column in (group.column(index) for index in range(group.num_columns)):
            pages += _page_bytes(file, column)
            check_expansion(pages, size)
    check_expansion(8.0 * rows * metadata.num_columns, size)


def _page_bytes(file: IO[bytes], column: Any) -> float:
    """Returns the decompressed bytes of a column's pages, as their headers state them."""
    position = column.dictionary_page_offset or column.data_page_offset
    position = min(position, column.data_page_offset)
    end = position + column.total_compressed_size
    total = 0.0
    while position < end:
        file.seek(position)
        header = _Compact(file.read(HEADER_BYTES))
        fields = header.leading_numbers()
        decompressed, compressed = fields[2], fields[3]
        if decompressed < 0 or compressed < 0:
            raise DataError("a page has a negative size.")
        total += decompressed
        position += header.position + compressed
    return total


class _Compact:
    """A structure in Thrift's compact protocol.

    Attributes:
        position: Bytes read so far.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0

    def leading_numbers(self) -> dict[int, int]:
        """Reads a structure; returns its fields 1 to 3, which are numbers, and skips the rest."""
        found: dict[int, int] = {}
        identifier = 0
        while kind := self._byte():
            identifier = identifier + (kind >> 4) if kind >> 4 else self._number()
            if identifier <= 3 and kind & 15 == 5:
                found[identifier] = self._number()
            else:
                self._skip(kind & 15, 0)
        return found

    def _byte(self) -> int:
        self.position += 1
        return self.data[self.position - 1]

    def _length(self) -> int:
        result = shift = 0
        while (byte := self._byte()) & 128:
            result |= (byte & 127) << shift
            shift += 7
        return result | byte << shift

    def _number(self) -> int:
        value = self._length()
        return (value >> 1) ^ -(value & 1)

    def _skip(self, kind: int, depth: int) -> None:
        if depth > LIMITS.depth:
            raise ValueError("nested too deeply")
        if kind in (4, 5, 6):
            self._length()
        elif kind == 3:
            self._byte()
        elif kind == 7:
            self.position += 8
        elif kind == 8:
            length = self._length()
            self.position += length
        elif kind in (9, 10):
            head = self._byte()
            length = head >> 4 if head >> 4 < 15 else self._length()
            for _ in range(length):
                self._skip(head & 15 if head & 15 > 2 else 3, depth + 1)
        elif kind == 12:
            while field := self._byte():
                if not field >> 4:
                    self._length()
                self._skip(field & 15, depth + 1)
        elif kind not in (1, 2):
            raise ValueError("not a page header")
