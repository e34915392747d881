"""Checks that an HDF5 file refers to no other file, and how much memory its data need.

HDF5 can take data from other files: by external and soft links, external storage, and virtual
data sets. A recording could then show any file that the user may read, or wait for a pipe.
NetCDF4 uses none of these.

A small file can also describe much data: by shapes whose chunks are not stored, by chunks that
inflate to more than they should, by texts that many elements share, and by groups that contain
each other. All of this is refused before anything is loaded. So are lists of texts whose end is
damaged, which the HDF5 library would read for ever.
"""

import math
import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath
from typing import Any

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion

__all__ = ["check_self_contained", "holds_lists", "named_netcdf"]

MAX_SHARED_TEXTS = 64
"""Largest number of texts in one attribute; each can be as long as the file."""

_FILTERS = (1, 2, 3)
"""Filters that NetCDF uses: deflate, shuffle and checksum. Others would load a plug-in."""

_DEFLATE = 1

_SIGNATURE = b"\x89HDF\r\n\x1a\n"

_HEAP = struct.Struct("<4sB3xQ")
"""Head of a global heap collection: its mark, version and size (HDF5 file format, III.E)."""

_HEAP_OBJECT = struct.Struct("<HHIQ")
"""Head of an object in it: index, number of references, nothing, and size."""


@contextmanager
def named_netcdf(path: str | PathLike[str]) -> Iterator[None]:
    """Turns every error in the block into a DataError that names the file."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{fspath(path)}: {error}") from None
    # Decoders raise nearly any error for corrupt bytes.
    except Exception as error:
        raise DataError(
            f"{fspath(path)} is not a readable NetCDF file ({type(error).__name__})."
        ) from error


def check_self_contained(path: str | PathLike[str], *, may_hold_lists: bool = False) -> None:
    """Checks an HDF5 file before any of its data are read.

    Args:
        path: The file.
        may_hold_lists: Whether data sets and attributes may hold lists of any length, such as
            compressed images or MATLAB's names of fields. These must not be read, since a damaged
            list can end the process; see :func:`holds_lists`.

    Raises:
        DataError: The file refers to another file, has too many parts, or describes more data
            than may be read from a file of its size.
        OSError: It is not an HDF5 file.
    """
    import h5py

    size = os.stat(path).st_size
    _check_heaps(path, size)
    needed = text = 0.0
    with h5py.File(path, "r") as file:
        for name, entry in _entries(file["/"]):
            text += _attribute_bytes(entry, name, size, may_hold_lists)
            if text > LIMITS.text_bytes:
                raise DataError(f"its attributes take more than {LIMITS.text_bytes} bytes.")
            if isinstance(entry, h5py.Dataset):
                if entry.is_virtual or entry.external:
                    raise DataError(
                        f"{_shown(name)} takes its data from another file, which is not read."
                    )
                needed += _described_bytes(entry)
                check_expansion(needed, size)
                _check_chunks(entry, name)
                kind = entry.id.get_type()
                if holds_lists(kind):
                    if not may_hold_lists:
                        raise DataError(f"{_shown(name)} holds lists, which are not read.")
                elif _varies(kind):
                    text += _text_bytes(entry, name)


def _check_heaps(path: str | PathLike[str], size: int) -> None:
    """Checks the lists of texts (global heap collections) of a file.

    Free space in such a list has the index 0, and a size that includes its head. The library moves
    on by this size; if it is 0, the library reads the same place for ever.
    """
    if size < 8:
        return
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        _check_lengths(data)
        left = size // _HEAP_OBJECT.size
        start = data.find(b"GCOL")
        while start >= 0 and start + _HEAP.size <= size:
            _, version, length = _HEAP.unpack_from(data, start)
            position, end = start + _HEAP.size, min(start + length, size)
            while version == 1 and position + _HEAP_OBJECT.size <= end:
                index, _, _, length = _HEAP_OBJECT.unpack_from(data, position)
                position += length if index == 0 else _HEAP_OBJECT.size + (length + 7) // 8 * 8
                left -= 1
                if (index == 0 and length == 0) or left < 0:
                    raise DataError("its texts are damaged.")
            start = data.find(b"GCOL", start + 4)


def _check_lengths(data: mmap.mmap) -> None:
    """Checks that lengths take eight bytes, as in all files of NetCDF and MATLAB."""
    start = 0
    while start + 16 <= len(data):
        if data[start : start + 8] == _SIGNATURE:
            lengths = data[start + (14 if data[start + 8] < 2 else 10)]
            if lengths in (2, 4, 16, 32):  # the library refuses all others itself
                raise DataError(f"its lengths take {lengths} bytes instead of 8.")
            return
        start = 2 * start or 512


def _entries(root: Any) -> Iterator[tuple[str, Any]]:
    """Yields all groups and data sets with their names; each may occur once, behind no link."""
    import h5py

    yield "/", root
    groups = [(root, 0)]
    seen = {root.id}  # equal for the same object, whatever its name
    while groups:
        group, depth = groups.pop()
        if len(group) > LIMITS.parts:
            raise DataError(f"it has more than {LIMITS.parts} parts.")
        for name in group:
            if type(group.get(name, getlink=True)) is not h5py.HardLink:
                raise DataError(f"{_shown(name)} is a link, which is not read.")
            entry = group[name]
            if entry.id in seen:
                raise DataError(f"{_shown(name)} is a second name of another part.")
            seen.add(entry.id)
            if len(seen) > LIMITS.parts:
                raise DataError(f"it has more than {LIMITS.parts} parts.")
            yield name, entry
            if isinstance(entry, h5py.Group):
                if depth >= LIMITS.depth:
                    raise DataError(f"its groups are nested more than {LIMITS.depth} deep.")
                groups.append((entry, depth + 1))


def _described_bytes(entry: Any) -> float:
    """Returns the bytes of a data set in memory, where numbers of fewer bytes become float64."""
    return math.prod(float(n) for n in entry.shape or ()) * max(8, entry.dtype.itemsize)


def _attribute_bytes(entry: Any, name: str, size: int, may_hold_lists: bool) -> float:
    """Returns the bytes of an entry's attributes, after checking that each may be read."""
    if len(entry.attrs) > LIMITS.parts:
        raise DataError(f"{_shown(name)} has more than {LIMITS.parts} attributes.")
    total = 0.0
    for key in entry.attrs:
        attribute = entry.attrs.get_id(key)
        count = math.prod(float(n) for n in attribute.shape or ())
        if holds_lists(attribute.get_type()):
            if may_hold_lists:
                continue
            raise DataError(f"the attribute {_shown(key)} holds lists, which are not read.")
        if not _varies(attribute.get_type()):
            total += count * attribute.dtype.itemsize
        elif count > MAX_SHARED_TEXTS:
            raise DataError(f"the attribute {_shown(key)} holds {count:.0f} texts.")
        elif count * size > LIMITS.text_bytes:
            # Only then can they be too long.
            total += _lengths(entry.attrs[key])
        if total > LIMITS.text_bytes:
            break
    return total


def _check_chunks(entry: Any, name: str) -> None:
    """Checks that chunks, which are decompressed as a whole, have the size that they should."""
    if entry.chunks is None:
        return
    creation = entry.id.get_create_plist()
    filters = [creation.get_filter(index)[0] for index in range(creation.get_nfilters())]
    if not set(filters) <= set(_FILTERS) or len(set(filters)) < len(filters):
        raise DataError(f"{_shown(name)} is compressed in a way that NetCDF does not use.")
    expected = math.prod(entry.chunks) * entry.dtype.itemsize
    check_expansion(expected, 0)
    count = entry.id.get_num_chunks()
    if count > LIMITS.parts:
        raise DataError(f"{_shown(name)} is stored in more than {LIMITS.parts} chunks.")
    if _DEFLATE not in filters:
        return
    for index in range(count):
        chunk = entry.id.get_chunk_info(index)
        _, stored = entry.id.read_direct_chunk(chunk.chunk_offset)
        if chunk.filter_mask & 1 << filters.index(_DEFLATE):
            continue
        # HDF5 would inflate any number of bytes. Four more are the checksum.
        if len(zlib.decompressobj().decompress(stored, expected + 5)) > expected + 4:
            raise DataError(f"{_shown(name)} decompresses to more than its shape says.")


def _text_bytes(entry: Any, name: str) -> float:
    """Returns the length of a data set's texts, read one by one since they may be the same one."""
    if entry.size > LIMITS.parts:
        raise DataError(f"{_shown(name)} has more than {LIMITS.parts} texts.")
    total = 0.0
    for position in range(entry.size):
        total += _lengths(entry[np.unravel_index(position, entry.shape)])
        if total > LIMITS.text_bytes:
            raise DataError(
                f"the texts of {_shown(name)} take more than {LIMITS.text_bytes} bytes."
            )
    return total


def _varies(kind: Any) -> bool:
    """Returns whether values of an HDF5 type have any length, and may share their bytes."""
    from h5py import h5t

    if isinstance(kind, h5t.TypeCompoundID):
        return any(_varies(kind.get_member_type(i)) for i in range(kind.get_nmembers()))
    if isinstance(kind, h5t.TypeArrayID):
        return _varies(kind.get_super())
    is_text = isinstance(kind, h5t.TypeStringID)
    return isinstance(kind, h5t.TypeVlenID) or (is_text and kind.is_variable_str())


def holds_lists(kind: Any) -> bool:
    """Returns whether values of an HDF5 type hold lists of anything but references.

    Args:
        kind: The type, as returned by ``get_type()`` of a data set's or attribute's ``id``.
    """
    from h5py import h5t

    if isinstance(kind, h5t.TypeCompoundID):
        return any(holds_lists(kind.get_member_type(i)) for i in range(kind.get_nmembers()))
    if isinstance(kind, h5t.TypeArrayID):
        return holds_lists(kind.get_super())
    is_list = isinstance(kind, h5t.TypeVlenID)
    return is_list and not isinstance(kind.get_super(), h5t.TypeReferenceID)


def _lengths(value: Any) -> float:
    return float(sum(map(len, value)) if hasattr(value, "shape") else len(value))


def _shown(name: str) -> str:
    """Returns a name for a message: short and printable."""
    return ascii(name[:40])
