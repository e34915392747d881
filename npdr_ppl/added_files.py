"""The folder of the effects that a user has added by `npdr effects --add`.

What it holds is known here without running the files, which needs torch.
"""

import ast
import os
import sys
from collections.abc import Iterator
from pathlib import Path

__all__ = ["added_files", "added_folder", "declared_ids"]

VARIABLE = "NPDR_EFFECTS"
"""Environment variable that names another folder."""


def added_folder() -> Path:
    """Returns the folder of added effects, which need not exist.

    It is the one that ``NPDR_EFFECTS`` names, or else ``npdr_ppl/effects`` in ``XDG_DATA_HOME`` or
    in the system's folder for the data of a user's programs.
    """
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given)
    return _data_folder() / "npdr_ppl" / "effects"


def added_files() -> list[Path]:
    """Returns the Python files of added effects, in alphabetical order."""
    folder = added_folder()
    return sorted(folder.glob("[!._]*.py")) if folder.is_dir() else []


def declared_ids(path: Path) -> list[str]:
    """Returns the ids that the classes of a file declare; none if it is no valid Python.

    Args:
        path: A Python file, which is not run.
    """
    try:
        classes = ast.parse(path.read_bytes()).body
    except (SyntaxError, ValueError, OSError):
        return []
    return [name for cls in classes if isinstance(cls, ast.ClassDef) for name in _ids(cls)]


def _ids(cls: ast.ClassDef) -> Iterator[str]:
    for part in cls.body:
        targets = part.targets if isinstance(part, ast.Assign) else []
        if isinstance(part, ast.AnnAssign):
            targets = [part.target]
        value = getattr(part, "value", None)
        is_id = any(isinstance(target, ast.Name) and target.id == "id" for target in targets)
        if is_id and isinstance(value, ast.Constant) and isinstance(value.value, str):
            yield value.value


def _data_folder() -> Path:
    given = os.environ.get("XDG_DATA_HOME", "")
    if os.path.isabs(given):  # others are to be ignored
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support"
    return Path.home() / ".local" / "share"
