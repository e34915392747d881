"""The code that a model consists of, by which runs notice that it has changed.

It is the part of the model's file that the model needs, the files beside it that this imports,
and the files that it names, such as a robot's. Comments and whatever else the file has do not
count, so that a script may be edited between two runs.
"""

import ast
import hashlib
import inspect
import sys
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from npdr_ppl.excerpts import excerpt
from npdr_ppl.model_identity import described, unwrapped

__all__ = ["ModelCode", "code_checksum", "code_of"]


@dataclass(frozen=True)
class ModelCode:
    """The code of a model without its layers.

    Attributes:
        file: The Python file that defines the model; ``None`` if there is none.
        text: The part of it that the model needs.
        neighbours: Code of the Python files in the same folder that it imports, directly or
            through others, by path.
        named: Files whose names the code has in quotation marks.
        is_alone: Whether the text means the same in another folder: it imports no neighbours, and
            names files by their whole paths only.
    """

    file: Path | None = None
    text: str = ""
    neighbours: Mapping[Path, str] = field(default_factory=dict)
    named: tuple[Path, ...] = ()
    is_alone: bool = True


def code_of(model: Any) -> ModelCode:
    """Returns the code of a model; it is empty if no file has it, as in a notebook.

    Args:
        model: A Pyro model, possibly inside layers and handlers.
    """
    base, _ = unwrapped(model)
    definition = base if inspect.isroutine(base) else type(base)
    # Of a function inside another one, the outer one is a part of the file.
    name = definition.__qualname__.partition(".")[0]
    try:
        file = Path(inspect.getsourcefile(definition) or "")
        needed = excerpt(_read(file), {name})
    except (OSError, TypeError, ValueError):
        return ModelCode()
    text = _plain("\n".join([*needed.imports, needed.body]))
    neighbours = _with_neighbours(text, file.parent)
    words = {word for each in (text, *neighbours.values()) for word in _texts(each)}
    named = {word: path for word in words if (path := _file_named(word, file.parent))}
    relative = {word: path for word, path in named.items() if not Path(word).is_absolute()}
    is_beside = any(path == file.parent / word for word, path in relative.items())
    return ModelCode(
        file=file,
        text=text,
        neighbours=neighbours,
        named=tuple(sorted(named.values())),
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
    for text in (code.text, *code.neighbours.values(), *map(described, effects)):
        digest.update(text.encode())
    for path in code.named:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _with_neighbours(text: str, folder: Path) -> dict[Path, str]:
    """Returns the code of the files in a folder that code imports, directly or through others."""
    found: dict[Path, str] = {}
    waiting = [text]
    while waiting:
        for module in _imported(waiting.pop()):
            file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
            is_beside = folder in (file.parent, file.parent.parent) and file.suffix == ".py"
            for each in _of_module(file) if is_beside else ():
                if each not in found:
                    found[each] = _plain(_read(each))
                    waiting.append(found[each])
    return found


def _of_module(file: Path) -> list[Path]:
    """Returns the files of a module, all of those of a package."""
    return sorted(file.parent.rglob("*.py")) if file.stem == "__init__" else [file]


def _imported(text: str) -> set[str]:
    """Returns the first parts of the names of the modules that code imports."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.partition(".")[0])
    return names


def _texts(text: str) -> Iterator[str]:
    """Yields the texts that code has in quotation marks."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def _file_named(word: str, folder: Path) -> Path | None:
    """Returns the file in a folder, or in the working directory, that a text names, if any."""
    try:
        return next((path for path in (folder / word, Path(word)) if path.is_file()), None)
    except (OSError, ValueError):  # too long, or a character that no path has
        return None


def _read(file: Path) -> str:
    with tokenize.open(file) as opened:
        return opened.read()


def _plain(text: str) -> str:
    """Returns code without comments, in one layout."""
    return ast.unparse(ast.parse(text))
