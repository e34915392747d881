"""Lists the files of a folder without following a link out of it."""

from pathlib import Path

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks

__all__ = ["check_inside", "files_in"]


def check_inside(folder: Path, file: Path) -> Path:
    """Returns a file of a folder.

    Raises:
        DataError: A symbolic link leads out of the folder.
    """
    if not file.resolve().is_relative_to(folder.resolve()):
        raise DataError(
            f"{rollout_checks.shown(file.name)} is a link out of the folder, which is not read."
        )
    return file


def files_in(folder: Path, suffix: str, pattern: str = "*") -> list[Path]:
    """Returns the regular files with a suffix in a folder, in the order of their names.

    Args:
        folder: The folder.
        suffix: Suffix in lower case, e.g. ``".csv"``.
        pattern: Where to look below the folder, as in ``Path.glob``, without ``**``.

    Raises:
        DataError: A file is a link out of the folder, or there are too many files.
    """
    found = []
    for number, file in enumerate(folder.glob(pattern)):
        if number > LIMITS.parts:
            raise DataError(f"it has more than {LIMITS.parts} files.")
        if file.suffix.lower() == suffix and file.is_file():
            found.append(check_inside(folder, file))
    return sorted(found, key=lambda file: (str(file.parent), len(file.name), file.name))
