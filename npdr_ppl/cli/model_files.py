"""Loads models from files: Python files, and robots' files from which a model is derived."""

import atexit
import importlib.util
import shutil
import sys
import tempfile
from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import cloudpickle

from npdr_ppl.engines.common.robot_files import relative_to
from npdr_ppl.errors import ModelError

__all__ = ["ROBOTS", "check_exists", "derived_model", "is_robot", "load_function"]

ROBOTS = (".xml", ".mjcf", ".urdf")
"""File name extensions of robot descriptions."""


def is_robot(word: str) -> bool:
    """Returns whether a word names a robot's file by its extension."""
    return Path(word).suffix.lower() in ROBOTS


def check_exists(path: Path, pattern: str, ending: str = "") -> None:
    """Raises a ModelError if a file of a model does not exist.

    Args:
        path: The file.
        pattern: Which files beside it may be meant, e.g. ``"*.py"``.
        ending: What follows the name of the file on the command line.
    """
    if not path.is_file():
        close = get_close_matches(path.name, [p.name for p in path.parent.glob(pattern)], n=1)
        hint = f" Did you mean {path.with_name(close[0])}{ending}?" if close else ""
        raise ModelError(f"{path} does not exist.{hint}")


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
    # The module gets a unique name: a file called json.py must not replace the library.
    name = f"_npdr_model_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ModelError(f"{path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    # Workers cannot import a module of this name, so its definitions are sent as code.
    cloudpickle.register_pickle_by_value(module)
    try:
        with relative_to(path.parent):
            spec.loader.exec_module(module)
    except Exception as error:
        raise ModelError(f"{path} cannot be loaded: {type(error).__name__}: {error}.") from error
    model = getattr(module, function, None)
    if not callable(model):
        own = [n for n, v in vars(module).items() if getattr(v, "__module__", "") == name]
        close = get_close_matches(function, own, n=1) or own[:1]
        hint = f" Did you mean {path}:{close[0]}?" if close else ""
        raise ModelError(f"{path} has no function {function!r}.{hint}")
    return model
