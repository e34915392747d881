"""The code that a model consists of, by which runs notice that it has changed.

It is the part of the model's file that the model needs, the files beside it that this imports,
and the files that it names, such as a robot's. Comments and whatever else the file has do not
count, so that a script may be edited between two runs.
"""

import ast
import functools
import hashlib
import inspect
import sys
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from npdr_ppl.excerpts import excerpt
from npdr_ppl.language.effects import Effect
from npdr_ppl.model_identity import unwrapped
from npdr_ppl.python_files import class_file, class_name, is_importable, loaded_files

__all__ = ["ModelCode", "code_checksum", "code_of"]


@dataclass(frozen=True)
class ModelCode:
    """The code of a model without its layers.

    Attributes:
        file: The Python file that defines the model; ``None`` if there is none.
        name: The model's name there; empty if it has none, such as a function inside another one.
        text: The part of it that the model needs.
        neighbours: Code of the Python files in the same folder that it imports, directly or
            through others, by path.
        named: Files whose names the code has in quotation marks.
        is_alone: Whether the text means the same in another folder: it imports no neighbours, and
            names no file beside it.
    """

    file: Path | None = None
    name: str = ""
    text: str = ""
    neighbours: Mapping[Path, str] = field(default_factory=dict)
    named: tuple[Path, ...] = ()
    is_alone: bool = True


def code_of(model: Any) -> ModelCode:
    """Returns the code of a model; it is empty if no file has it, as in a notebook.

    Args:
        model: A Pyro model, possibly inside layers and handlers.
    """
    try:
        file, name, outermost = _place(unwrapped(model)[0])
        text = _needed(file, name or outermost)
    except (OSError, TypeError):
        return ModelCode()
    neighbours = _neighbours(text, file.parent)
    words = {word for each in (text, *neighbours.values()) for word in _texts(each)}
    named = {word: path for word in words if (path := _file_named(word, file.parent))}
    relative = {word: path for word, path in named.items() if not Path(word).is_absolute()}
    is_beside = any(path == file.parent / word for word, path in relative.items())
    return ModelCode(
        file=file,
        name=name,
        text=text,
        neighbours=neighbours,
        named=tuple(sorted(set(named.values()))),
        is_alone=not (neighbours or is_beside or "__file__" in text),
    )


def code_checksum(model: Any) -> str:
    """Returns a checksum of a model's code, of the files that it names, and of its effects.

    Args:
        model: A Pyro model, possibly inside layers and handlers.
    """
    code = code_of(model)
    _, effects = unwrapped(model)
    digest = hashlib.sha256()
    for text in (code.text, *code.neighbours.values(), *map(_code_of_effect, effects)):
        digest.update(text.encode())
    for path in code.named:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _place(model: Any) -> tuple[Path, str, str]:
    """Returns the file that defines a model, the model's name there, and the outer definition's.

    The model's name is empty if the file has none for it, as for a function inside another one.

    Raises:
        OSError: There is no such file.
        TypeError: It is built in.
    """
    definition = inspect.unwrap(model)
    while isinstance(definition, functools.partial):
        definition = inspect.unwrap(definition.func)
    if not inspect.isroutine(definition):
        definition = type(definition)
    # The arguments of a factory or a class are in the file that gives the model its name.
    defining, script = map(sys.modules.get, (definition.__module__, "__main__"))
    for module in (defining, *loaded_files(), script):
        names = [name for name, value in list(vars(module or object).items()) if value is model]
        file = getattr(module, "__file__", None)
        if names and file:
            own = getattr(model, "__name__", "")
            return Path(file), own if own in names else names[0], ""
    outermost = definition.__qualname__.partition(".")[0]
    return Path(inspect.getsourcefile(definition) or ""), "", outermost


def _needed(file: Path, name: str) -> str:
    """Returns the part of a file that a name needs; all of it if it does not define it."""
    text = _read(file)
    try:
        needed = excerpt(text, {name})
    except (SyntaxError, ValueError):
        return text
    return _plain("\n".join([*needed.imports, needed.body]) if needed.body else text)


def _code_of_effect(effect: Effect) -> str:
    """Returns an effect's arguments, and the code of its class if a user's file defines it."""
    own = type(effect)
    file = None if is_importable(own.__module__) else class_file(own)
    return repr(effect) if file is None else f"{effect!r}\n{_needed(file, class_name(own))}"


def _neighbours(text: str, folder: Path) -> dict[Path, str]:
    """Returns the code of the files in a folder that code imports, directly or through others."""
    found: dict[Path, str] = {}
    waiting = [text]
    while waiting:
        for module in sorted(_imported(waiting.pop())):
            for file in _files_of(module, folder):
                if file not in found:
                    found[file] = _plain(_read(file))
                    waiting.append(found[file])
    return dict(sorted(found.items()))


def _files_of(module: str, folder: Path) -> list[Path]:
    """Returns the Python files of a module in a folder, all of those of a package."""
    spec = PathFinder.find_spec(module) or PathFinder.find_spec(module, [str(folder)])
    # In the folder of installed packages, all of these would be neighbours.
    if spec is None or folder.name in ("site-packages", "dist-packages"):
        return []
    packages = [Path(place) for place in spec.submodule_search_locations or ()]
    if packages:
        own = [place for place in packages if folder in (place, place.parent)]
        return sorted(file for place in own for file in place.rglob("*.py"))
    file = Path(spec.origin or "")
    return [file] if file.parent == folder and file.suffix == ".py" else []


def _imported(text: str) -> set[str]:
    """Returns the first parts of the names of the modules that code imports."""
    names = set()
    for node in ast.walk(_parsed(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names


def _texts(text: str) -> Iterator[str]:
    """Yields the texts that code has in quotation marks."""
    for node in ast.walk(_parsed(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def _file_named(word: str, folder: Path) -> Path | None:
    """Returns the file in a folder, or in the working directory, that a text names, if any."""
    try:
        return next((path for path in (folder / word, Path(word)) if path.is_file()), None)
    except (OSError, ValueError):  # too long, or a character that no path has
        return None


def _read(file: Path) -> str:
    try:
        with tokenize.open(file) as opened:
            return opened.read()
    except (SyntaxError, UnicodeDecodeError):
        return file.read_bytes().decode(errors="replace")


def _plain(text: str) -> str:
    """Returns code without comments, in one layout; other texts as they are."""
    return ast.unparse(_parsed(text)) or text


def _parsed(text: str) -> ast.Module:
    """Returns the statements of code, none of a text that is no code, such as a template's."""
    try:
        return ast.parse(text)
    except (SyntaxError, ValueError):
        return ast.Module([], [])
