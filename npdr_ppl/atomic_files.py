"""Files that are written completely or not at all."""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

__all__ = ["remove_leftovers", "replacing"]

LEFTOVER = re.compile(r"\..+\.[a-z0-9_]{8}\.tmp")
"""Names of the temporary files of :func:`replacing`."""

DEEPEST = 3
"""Number of folders below that of a run in which it writes files."""


def remove_leftovers(folder: Path) -> None:
    """Removes temporary files that a killed process has left in a folder that nobody else uses."""
    for depth in range(DEEPEST + 1):
        for file in folder.glob(f"{'*/' * depth}.*.tmp"):
            if LEFTOVER.fullmatch(file.name):
                file.unlink(missing_ok=True)


@contextmanager
def replacing(path: str | PathLike[str]) -> Iterator[Path]:
    """Yields a temporary path in the same folder that replaces ``path`` if the block succeeds.

    Even if the program is killed, readers see either the old file or the complete new one.
    """
    target = Path(path)
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(
            dir=target.parent, prefix=f".{target.name[:100]}.", suffix=".tmp"
        )
        os.close(handle)
        temporary = Path(name)
        # mkstemp makes private files; a data file should get the usual permissions.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        os.replace(temporary, target)
    except OSError as error:  # such as a full disk, which does not say which file it is about
        error.filename = str(target)
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
