"""Checks that an HDF5 file contains all of its data itself.

HDF5 can take data from other files: by external and soft links, external storage, and virtual
data sets. A recording could then show any file that the user may read, or wait for a pipe.
NetCDF4 uses none of these.
"""

from os import PathLike
from typing import Any

from npdr_ppl.errors import DataError

__all__ = ["check_self_contained"]

MAX_OBJECTS = 10_000
"""Greatest number of groups and data sets in a file; recordings have tens, posteriors hundreds."""


def check_self_contained(path: str | PathLike[str]) -> None:
    """Checks an HDF5 file before any of its data are read.

    Raises:
        DataError: The file refers to another file, or has too many parts.
        OSError: It is not an HDF5 file.
    """
    import h5py

    with h5py.File(path, "r") as file:
        groups: list[Any] = [file["/"]]
        seen = {groups[0].id}  # equal for the same object, whatever its name
        while groups:
            group = groups.pop()
            for name in group:
                if type(group.get(name, getlink=True)) is not h5py.HardLink:
                    raise DataError(f"{_shown(name)} is a link, which is not read.")
                entry = group[name]
                if entry.id in seen:
                    continue
                seen.add(entry.id)
                if len(seen) > MAX_OBJECTS:
                    raise DataError(f"it has more than {MAX_OBJECTS} parts.")
                if isinstance(entry, h5py.Dataset):
                    _check_storage(entry, name)
                elif isinstance(entry, h5py.Group):
                    groups.append(entry)


def _check_storage(entry: Any, name: str) -> None:
    if entry.is_virtual or entry.external:
        raise DataError(f"{_shown(name)} takes its data from another file, which is not read.")


def _shown(name: str) -> str:
    """Returns a name for a message: short and printable."""
    return ascii(name[:40])
