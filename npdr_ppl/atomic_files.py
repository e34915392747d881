"""Files that are written completely or not at all."""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

__all__ = ["remove_unfinished", "replacing"]

_UNFINISHED = re.compile(r"\..+\.[a-z0-9_]{8}\.tmp")


def remove_unfinished(folder: Path) -> None:
    """Removes the temporary files that a killed process left in a folder and below it.

    No other process may write to the folder meanwhile.
    """
    for file in folder.rglob(".*.tmp"):
        if _UNFINISHED.fullmatch(file.name) and file.is_file():
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
