"""Loads models from files: Python files, and robots' files from which a model is derived."""

import atexit
import shutil
import tempfile
from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType
from typing import Any

from npdr_ppl.engines.common.robot_files import relative_to
from npdr_ppl.errors import ModelError
from npdr_ppl.python_files import check_exists, load_python_file, neighbours_of, own_names

__all__ = ["ROBOTS", "derived_model", "is_robot", "load_function", "load_relative"]

ROBOTS = (".xml", ".mjcf", ".urdf")
"""File name extensions of robot descriptions."""


def is_robot(word: str) -> bool:
    """Returns whether a word names a robot's file by its extension."""
    return Path(word).suffix.lower() in ROBOTS


def derived_model(path: Path) -> Callable[..., Any]:
    """Returns the model that is derived from a robot's file.

    Its source is a temporary file, so that runs record it as that of any other model.

    Args:
        path: The robot's MJCF or URDF file.

    Raises:
        ModelError: The file is bad, or no model can be derived from it.
    """
    from npdr_ppl.engines.mujoco.derived_model import derive_model

    check_exists(path, "*.*")
    source = derive_model(path).source(path.absolute())
    folder = tempfile.mkdtemp(prefix="npdr-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    file = Path(folder) / f"{path.stem}.py"
    file.write_text(source, encoding="utf-8")
    return load_function(file, "model")


def load_function(path: Path, function: str) -> Callable[..., Any]:
    """Returns a function of a Python file.

    Paths of robots' files that the file names are relative to its folder.

    Args:
        path: The Python file.
        function: Name of the function.

    Raises:
        ModelError: There is no such file or function, or the file raises an error.
    """
    check_exists(path, "*.py", f":{function}")
    module = load_relative(path)
    found = getattr(module, function, None)
    if not callable(found):
        own = own_names(module)
        close = get_close_matches(function, own, n=1) or own[:1]
        hint = f" Did you mean {path}:{close[0]}?" if close else ""
        raise ModelError(f"{path} has no function {function!r}.{hint}")
    return found


def load_relative(path: Path) -> ModuleType:
    """Returns the module of a Python file, whose paths are relative to the file's folder.

    It can import the Python files beside it; see :func:`npdr_ppl.python_files.neighbours_of`.

    Args:
        path: The file, which must exist.

    Raises:
        ModelError: The file raises an error.
    """
    try:
        with relative_to(path.parent), neighbours_of(path):
            return load_python_file(path)
    except ModelError as error:
        lacks = error.__cause__
        if not isinstance(lacks, ModuleNotFoundError):
            raise
        raise ModelError(
            f"{error} If it is a file of yours, put {path.name} into the same folder, or set "
            "PYTHONPATH to the file's folder; if it is a package, install it."
        ) from lacks
