"""Reads HDF5 files, also those that MATLAB writes as MAT 7.3."""

from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.hdf5_checks import check_self_contained, holds_lists
from npdr_ppl.rollouts.logs.formats.trees import Leaf, log_of_tree
from npdr_ppl.rollouts.logs.log import Log
from npdr_ppl.rollouts.logs.log_settings import LogSettings

__all__ = ["is_hdf5", "read_hdf5_log"]

_MATLAB_NUMBERS = {
    *(b"double", b"single", b"logical"),
    *(f"{sign}int{bits}".encode() for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
"""Classes of MATLAB whose data sets hold numbers; text is stored as integers, too."""


def is_hdf5(path: Path) -> bool:
    """Returns whether a file holds HDF5, also behind the header that MATLAB writes."""
    with path.open("rb") as file:
        head = file.read(520)
    return head[:8] == b"\x89HDF\r\n\x1a\n" or head[512:520] == b"\x89HDF\r\n\x1a\n"


def read_hdf5_log(path: Path, settings: LogSettings) -> Log:
    """Reads all data sets of numbers with one or two dimensions.

    Args:
        path: The file.
        settings: How to read it.

    Raises:
        DataError: The file refers to other files, is too large in memory, or has no time.
    """
    import h5py

    check_self_contained(path, may_hold_lists=True)
    leaves: dict[str, Leaf] = {}

    def visit(name: str, entry: Any) -> None:
        # MATLAB keeps what references point to, such as the cells of arrays, in this group.
        if not isinstance(entry, h5py.Dataset) or name.startswith("#refs#"):
            return
        if entry.dtype.kind not in "fiub" or entry.ndim not in (1, 2) or not entry.size:
            return
        matlab = _attribute(entry, "MATLAB_class")
        if matlab is not None and bytes(np.bytes_(matlab)) not in _MATLAB_NUMBERS:
            return
        values = np.asarray(entry[()], dtype=np.float64)
        # MATLAB stores columns first.
        leaves[name] = Leaf(values.T if matlab is not None else values, _unit(entry))

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    if not leaves:
        raise DataError("it has no data sets of numbers.")
    return log_of_tree(path.name, leaves, settings)


def _attribute(entry: Any, key: str) -> Any:
    """Returns an attribute; ``None`` if there is none, or if it holds lists."""
    if key not in entry.attrs or holds_lists(entry.attrs.get_id(key).get_type()):
        return None
    return entry.attrs[key]


def _unit(entry: Any) -> str:
    """Returns the unit that a data set states, ``""`` if none or no text."""
    for key in ("units", "unit"):
        word = _attribute(entry, key)
        if isinstance(word, bytes):
            word = word.decode(errors="replace")
        if isinstance(word, str):
            return word if len(word) <= 30 and word.isprintable() else ""
    return ""
