"""Loads Python files of users: models, targets and effects that no installed package has."""

import hashlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle

from npdr_ppl.errors import ModelError

__all__ = [
    "check_exists",
    "class_file",
    "class_name",
    "is_importable",
    "load_python_file",
    "loaded_files",
    "neighbours_of",
    "own_names",
]

_TEXT = "__npdr_text__"
"""Name in a loaded module of the bytes that it was loaded from."""


class _Folder(str):
    """The folder of a loaded file in ``sys.path``, which is no installed package's."""


def check_exists(path: Path, pattern: str, ending: str = "") -> None:
    """Raises a ModelError if a file does not exist.

    Args:
        path: The file.
        pattern: Which files beside it may be meant, e.g. ``"*.py"``.
        ending: What follows the name of the file on the command line.
    """
    if not path.is_file():
        close = get_close_matches(path.name, [p.name for p in path.parent.glob(pattern)], n=1)
        hint = f" Did you mean {path.with_name(close[0])}{ending}?" if close else ""
        raise ModelError(f"{path} does not exist.{hint}")


def load_python_file(path: Path) -> ModuleType:
    """Returns the module that a Python file defines; an unchanged file is run only once.

    Files of the same name in two folders are two modules, and a file called ``json.py`` does not
    replace the library.

    Args:
        path: The file, which must exist.

    Raises:
        ModelError: The file raises an error.
    """
    absolute = str(path.absolute())
    digest = hashlib.sha256(absolute.encode()).hexdigest()[:12]
    stem = re.sub(r"\W", "_", path.stem)
    name = f"_npdr_{stem}_{digest}"
    text = path.read_bytes()
    loaded = sys.modules.get(name)
    if loaded is not None and getattr(loaded, _TEXT, None) == text:
        return loaded
    spec = importlib.util.spec_from_file_location(name, absolute)
    if spec is None:
        raise ModelError(f"{path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    # Workers cannot import a module of this name, so its definitions are sent as code.
    cloudpickle.register_pickle_by_value(module)
    try:
        # Not by the spec's loader: it takes a file for unchanged that was changed within a second.
        exec(compile(text, absolute, "exec"), vars(module))
    except (Exception, SystemExit) as error:
        cloudpickle.unregister_pickle_by_value(module)
        del sys.modules[name]
        raise ModelError(f"{path} cannot be loaded: {type(error).__name__}: {error}.") from error
    setattr(module, _TEXT, text)
    return module


def loaded_files() -> list[ModuleType]:
    """Returns the modules of the Python files that are loaded."""
    return [module for module in list(sys.modules.values()) if hasattr(module, _TEXT)]


@contextmanager
def neighbours_of(path: Path) -> Iterator[None]:
    """Lets a file that is loaded inside the block import the Python files beside it.

    The folder stays at the end of ``sys.path``, for imports inside functions and for worker
    processes, which get this path. Unlike a script's folder it comes after the libraries: a
    neighbour called ``json.py`` does not replace the library, and an installed package comes
    before a neighbour of the same name.

    Two files in different folders may not import neighbours of the same name, because a worker
    would find only one of them. Imports inside functions are not checked for this.

    Args:
        path: The file.

    Raises:
        ModelError: The file imported a neighbour whose name is that of another file's neighbour.
    """
    folder = str(path.parent.absolute())
    if folder not in sys.path:
        # Before the folders of other files, so that its own neighbours are found first.
        marked = [i for i, other in enumerate(sys.path) if isinstance(other, _Folder)]
        sys.path.insert(min(marked, default=len(sys.path)), _Folder(folder))
    others = _neighbours_elsewhere(folder)
    for name in others:
        del sys.modules[name]
    try:
        yield
        both = [name for name in others if name in sys.modules]
    finally:
        sys.modules.update(others)
    if both:
        # The file's own module is forgotten, so that loading it again fails in the same way.
        for name, module in list(sys.modules.items()):
            if getattr(module, "__file__", None) == str(path.absolute()):
                del sys.modules[name]
        raise ModelError(
            f"{path} imports {both[0]}.py, but another file has imported "
            f"{others[both[0]].__file__}, which has the same name; rename one of them."
        )


def _neighbours_elsewhere(folder: str) -> dict[str, ModuleType]:
    """Returns the neighbours of other files by name that a folder has modules for, too."""
    folders = {other for other in sys.path if isinstance(other, _Folder)} - {folder}
    found = {}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        # The other entries of sys.modules are quickly told apart by their folder.
        if file is not None and _home(Path(file)) in folders and "." not in name:
            if PathFinder.find_spec(name, [folder]) is not None:
                found[name] = module
    return found


def _home(file: Path) -> str:
    """Returns the folder in which a module or package is found."""
    return str(file.parent.parent if file.stem == "__init__" else file.parent)


def own_names(module: ModuleType) -> list[str]:
    """Returns the names of the functions and classes that a module itself defines."""
    name = module.__name__
    return [n for n, value in vars(module).items() if getattr(value, "__module__", "") == name]


def is_importable(module: str) -> bool:
    """Returns whether a module belongs to an installed package.

    Modules of :func:`load_python_file`, files beside them, and ``__main__`` do not.

    Args:
        module: Its name, e.g. ``"npdr_ppl.models.pendulum"``.
    """
    # importlib.util.find_spec would also find modules that were loaded from a file by path.
    top = module.partition(".")[0]
    installed = [folder for folder in sys.path if not isinstance(folder, _Folder)]
    return top != "__main__" and PathFinder.find_spec(top, installed) is not None


def class_file(cls: type[Any]) -> Path | None:
    """Returns the file that defines a class; ``None`` if there is none.

    It is found in worker processes, too, to which a class is sent as code without its module.
    """
    # A decorator may have put a function of another file around that of the class.
    functions = map(inspect.unwrap, filter(inspect.isfunction, vars(cls).values()))
    own = [f.__code__.co_filename for f in functions if f.__module__ == cls.__module__]
    # A class may have no function of its own.
    module = getattr(sys.modules.get(cls.__module__), "__file__", None)
    paths = map(Path, [*own, *([module] if module else [])])
    # A relative path is that of code made from a text, not of a file.
    return next((path for path in paths if path.is_absolute() and path.is_file()), None)


def class_name(cls: type[Any]) -> str:
    """Returns the name by which a class is found in its module, mostly its own name."""
    names = vars(sys.modules.get(cls.__module__, object))
    if names.get(cls.__name__) is cls:
        return cls.__name__
    return next((name for name, value in names.items() if value is cls), cls.__name__)
