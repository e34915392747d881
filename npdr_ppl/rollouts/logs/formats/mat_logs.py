"""Reads MAT files of version 5 (MATLAB's ``save``): numeric arrays and structs.

The format is read here rather than by a library, because every size that a file states is compared
with the bytes that it has before any memory is allocated. Objects, function handles, cells, sparse
and complex arrays are left out. Version 7.3 is HDF5.

References:
    MathWorks, MAT-File Format (R2024b), chapter 1.
"""

import math
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.hdf5_logs import is_hdf5, read_hdf5_log
from npdr_ppl.rollouts.logs.formats.trees import Leaf, log_of_tree
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

__all__ = ["read_mat_log"]

HEADER_BYTES = 128

_MATRIX, _COMPRESSED = 14, 15
"""Types of elements that are not plain numbers."""

_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8",
           13: "u8"}  # fmt: skip
"""Types of the numbers of an element."""

_STRUCT, _NUMBERS = 2, range(6, 16)
"""Classes of arrays that are read; 6 to 15 are double, single and integers."""

_COMPLEX = 0x0800
"""Flag of an array with an imaginary part."""


def read_mat_log(path: Path, settings: LogSettings) -> Log:
    """Reads the numeric arrays of a MAT file, also those in structs.

    Args:
        path: The file, version 5 to 7.3.
        settings: How to read it.

    Raises:
        DataError: It is damaged, too large in memory, or has no time.
    """
    if is_hdf5(path):
        return read_hdf5_log(path, settings)
    data = path.read_bytes()
    mark = data[126:128]
    if len(data) < HEADER_BYTES or mark not in (b"IM", b"MI"):
        raise DataError("it is not a MAT file of version 5 or later.")
    arrays = _Arrays("<" if mark == b"IM" else ">", len(data))
    arrays.read_file(data)
    if not arrays.leaves:
        raise DataError("it has no numeric arrays.")
    return log_of_tree(path.name, arrays.leaves, settings)


class _Arrays:
    """The numeric arrays found so far.

    Attributes:
        leaves: Arrays by path.
    """

    def __init__(self, order: Literal["<", ">"], file_bytes: int) -> None:
        self.leaves: dict[str, Leaf] = {}
        self._order: Literal["<", ">"] = order
        self._endianness: Literal["little", "big"] = "little" if order == "<" else "big"
        self._file_bytes = file_bytes
        self._bytes = 0.0
        self._parts = 0

    def read_file(self, data: bytes) -> None:
        """Reads all variables of a file."""
        position = HEADER_BYTES
        while position + 8 <= len(data):
            kind, length, start = self._tag(data, position)
            body = data[start : start + length]
            if kind == _COMPRESSED:
                body = self._inflated(body)
                kind, length, start = self._tag(body, 0)
                body = body[start : start + length]
                # Compressed elements are not padded.
                position += 8 + self._tag(data, position)[1]
            else:
                position = start + length + -length % 8
            if len(body) < length:
                raise DataError("it ends within an array.")
            if kind == _MATRIX:
                self._matrix(body, "", 0)

    def _inflated(self, body: bytes) -> bytes:
        left = int(max(LIMITS.free_bytes, LIMITS.expansion * self._file_bytes) - self._bytes)
        result = zlib.decompressobj().decompress(body, max(1, left + 1))
        self._bytes += len(result)
        check_expansion(self._bytes, self._file_bytes)
        return result

    def _tag(self, data: bytes, position: int) -> tuple[int, int, int]:
        """Returns type, bytes and start of the element at a position."""
        if position + 8 > len(data):
            raise DataError("it ends within an array.")
        first = int.from_bytes(data[position : position + 4], self._endianness)
        if first >> 16:  # a small element keeps its numbers beside the type
            return first & 0xFFFF, min(first >> 16, 4), position + 4
        return (
            first,
            int.from_bytes(data[position + 4 : position + 8], self._endianness),
            (position + 8),
        )

    def _element(self, data: bytes, position: int) -> tuple[int, bytes, int]:
        """Returns type and bytes of an element, and where the next one begins."""
        kind, length, start = self._tag(data, position)
        if start + length > len(data):
            raise DataError("it ends within an array.")
        is_small = start == position + 4
        after = position + 8 if is_small else start + length + -length % 8
        return kind, data[start : start + length], after

    def _numbers(self, kind: int, body: bytes) -> NDArray[np.float64]:
        if kind not in _STORED:
            raise DataError(f"an array holds numbers of the unknown type {kind}.")
        stored = np.dtype(_STORED[kind]).newbyteorder(self._order)
        count = len(body) // stored.itemsize
        self._bytes += 8.0 * count
        check_expansion(self._bytes, self._file_bytes)
        return np.frombuffer(body, stored, count).astype(np.float64)

    def _matrix(self, data: bytes, path: str, depth: int) -> None:
        """Reads an array, or the fields of a struct, into :attr:`leaves`."""
        self._parts += 1
        if depth > LIMITS.depth or self._parts > LIMITS.parts:
            raise DataError(f"it has more than {LIMITS.parts} parts, or is nested too deeply.")
        if not data:
            return  # an empty cell or field
        kind, body, position = self._element(data, 0)
        flags = int.from_bytes(body[:4], self._endianness)
        code = flags & 0xFF
        if kind != 6 or (code != _STRUCT and code not in _NUMBERS) or flags & _COMPLEX:
            return
        kind, body, position = self._element(data, position)
        shape = tuple(int(n) for n in self._numbers(kind, body)) if kind == 5 else ()
        _, body, position = self._element(data, position)
        name = body.decode("ascii", errors="replace")
        path = f"{path}{name}" if not path or not name else f"{path}/{name}"
        if len(path) > LIMITS.line_length:
            raise DataError("its names are too long.")
        if code == _STRUCT:
            self._struct(data, position, path, shape, depth)
        elif len(shape) == 2 and path:
            kind, body, _ = self._element(data, position)
            values = self._numbers(kind, body)
            if min(shape) < 0 or math.prod(shape) != len(values):
                raise DataError(
                    f"{rollout_checks.shown(path)} has {len(values)} values for the shape {shape}."
                )
            self.leaves[path] = Leaf(values.reshape(shape, order="F"))

    def _struct(
        self, data: bytes, position: int, path: str, shape: tuple[int, ...], depth: int
    ) -> None:
        """Reads the fields of a struct; elements of an array of structs are counted from 0."""
        _, body, position = self._element(data, position)
        width = int.from_bytes(body[:4], self._endianness)
        _, body, position = self._element(data, position)
        if not 0 < width <= 64:
            raise DataError(f"{rollout_checks.shown(path)} has field names of {width} bytes.")
        fields = [
            body[k : k + width].partition(b"\0")[0].decode("ascii", errors="replace")
            for k in range(0, len(body), width)
        ]
        count = math.prod(shape)
        if count < 0 or count * max(1, len(fields)) > LIMITS.parts:
            raise DataError(f"{rollout_checks.shown(path)} has more than {LIMITS.parts} parts.")
        for index in range(count):
            for field in fields:
                kind, body, position = self._element(data, position)
                if kind == _MATRIX:
                    inner = path if count == 1 else f"{path}.{index}"
                    self._matrix(body, f"{inner}/{field}", depth + 1)
