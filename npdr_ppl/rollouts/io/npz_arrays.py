"""Reads the arrays of an NPZ file after checking how much memory they need."""

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS, check_expansion

__all__ = ["read_arrays"]

_END, _END_64 = b"PK\x05\x06", b"PK\x06\x07"
_END_BYTES = 22
_LONGEST_END = _END_BYTES + 2**16

MAX_TEXT_LENGTH = 200
"""Longest text of an array in characters; names have at most 100, units fewer."""


def read_arrays(
    path: Path, required: Mapping[str, int], optional: Mapping[str, int]
) -> dict[str, NDArray[Any]]:
    """Returns some arrays of an NPZ file.

    Args:
        path: The file.
        required: Number of dimensions, by name, of the arrays that the file must contain.
        optional: The same for arrays that may be missing.

    Raises:
        DataError: An array is missing, too large, or not of numbers or text.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        _check_directory(file, size)
        with zipfile.ZipFile(file) as archive:
            members = {m.filename.removesuffix(".npy"): m for m in archive.infolist()}
            missing = [name for name in required if name not in members]
            if missing:
                raise DataError(
                    f"there is no array {missing[0]}, which to_npz would have written."
                )
            wanted = {n: d for n, d in {**required, **optional}.items() if n in members}
            needed = 0.0
            for name, dimensions in wanted.items():
                needed += _checked_bytes(archive, members[name], name, dimensions)
            check_expansion(needed, size)
            arrays = {}
            for name in wanted:
                with archive.open(members[name]) as content:
                    arrays[name] = np.lib.format.read_array(content, allow_pickle=False)
            return arrays


def _check_directory(file: IO[bytes], size: int) -> None:
    """Checks the length of the list of members, which is parsed as a whole."""
    file.seek(max(0, size - _LONGEST_END))
    tail = file.read()
    at = tail.rfind(_END)
    if at < 0 or len(tail) - at < _END_BYTES:
        raise zipfile.BadZipFile
    # The extended form, for more than 65 535 members, states the length elsewhere.
    is_extended = tail[max(0, at - 20) : at].startswith(_END_64)
    length = int.from_bytes(tail[at + 12 : at + 16], "little")
    if is_extended or length > LIMITS.text_bytes:
        raise DataError("it has more members than a recording.")
    file.seek(0)


def _checked_bytes(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, dimensions: int
) -> float:
    """Returns the bytes that an array takes in memory, after checking its header."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DataError(f"the array {name} is compressed in a way that NumPy does not write.")
    with archive.open(member) as content:
        version = np.lib.format.read_magic(content)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, _, dtype = reader(content)
    if dtype.hasobject or dtype.kind not in "fiuU":
        raise DataError(f"the array {name} is of type {str(dtype)[:40]}.")
    is_text = name.endswith(("_names", "_units"))
    if is_text != (dtype.kind == "U"):
        raise DataError(f"the array {name} should hold {'text' if is_text else 'numbers'}.")
    if len(shape) != dimensions:
        raise DataError(
            f"the array {name} has {len(shape)} dimensions, but {dimensions} are needed."
        )
    if math.prod(float(n) for n in shape) * dtype.itemsize > member.file_size:
        raise DataError(f"the array {name} is shorter than its header says.")
    if is_text and (shape[0] > LIMITS.columns or dtype.itemsize > 4 * MAX_TEXT_LENGTH):
        raise DataError(f"the array {name} holds longer or more words than a recording.")
    if name == "lengths" and dtype.kind == "f":
        raise DataError("the array lengths should hold integers.")
    if name != "time_step" and not is_text and shape[0] > LIMITS.rollouts:
        raise DataError(f"it has {shape[0]} rollouts, more than {LIMITS.rollouts}.")
    # Numbers of fewer bytes become float64.
    return math.prod(shape) * float(dtype.itemsize if is_text else max(8, dtype.itemsize))
