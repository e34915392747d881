"""The source of effects that a user's own files define, as a part of another file.

An effect's class, and what it needs of its file, is copied. If it needs a name that the other file
has for something else, the copy is put into a function of its own.
"""

import ast
import io
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from npdr_ppl.excerpts import Excerpt, bound_names, excerpt, import_lines
from npdr_ppl.language.effects import Effect
from npdr_ppl.python_files import class_file, class_name, is_importable
from npdr_ppl.python_text import plain

__all__ = ["EffectSources", "sources_of"]

_TEXTS = ("STRING", "FSTRING_MIDDLE", "TSTRING_MIDDLE")
"""Kinds of tokens inside which spaces mean something; f-strings have theirs from Python 3.12."""

_OWN_NAMES = ("revised_model", "PRIORS", "CLOSEST_FIT")
"""Names that a revised model's file defines itself."""


@dataclass
class EffectSources:
    """The classes of effects in the text of a file.

    Attributes:
        head: The text in front of them.
        imports: Imports, one name each.
        blocks: Lines of the classes that are copied.
        names: The name of each class in the file.
    """

    head: str
    imports: set[str]
    blocks: list[str] = field(default_factory=list)
    names: dict[type[Effect], str] = field(default_factory=dict)


def sources_of(
    classes: Sequence[type[Effect]], head: str, home: Path | None, imports: set[str]
) -> EffectSources:
    """Returns the source of effects' classes, imports where they are installed.

    Args:
        classes: The classes; the same one may occur several times.
        head: Text in front of them, which may define names.
        home: The file that ``head`` is a copy of; its classes are there already.
        imports: Further imports that follow ``head``, one name each.
    """
    result = EffectSources(head, set(imports))
    files: dict[Path, list[type[Effect]]] = {}
    taken = bound_names("\n".join([head, *import_lines(imports)]))
    for cls in dict.fromkeys(classes):
        name, file = class_name(cls), class_file(cls)
        result.names[cls] = name
        if is_importable(cls.__module__):
            line = f"from {cls.__module__} import {name}"
            if taken.setdefault(name, line) != line:  # the head has something else of this name
                result.names[cls] = _free(name, taken)
                line = f"{line} as {result.names[cls]}"
                taken[result.names[cls]] = line
            result.imports.add(line)
        elif file is None:
            result.blocks += ["", f"# The source of {name} was not found: import it here."]
        elif home is None or file.resolve() != home.resolve():
            files.setdefault(file.resolve(), []).append(cls)
    taken |= {name: "the revised model's own" for name in _OWN_NAMES}
    for file, own in files.items():
        _copy(file, own, result, taken)
    return result


def _copy(
    file: Path, classes: Sequence[type[Effect]], result: EffectSources, taken: dict[str, str]
) -> None:
    """Adds the source of the classes of one file to a result, and the names to those taken."""
    with tokenize.open(file) as opened:
        part = excerpt(opened.read(), {result.names[cls] for cls in classes})
    result.head = _with_futures(result.head, part.futures)
    if not part.collides_with(taken):
        result.imports |= set(part.imports)
        result.blocks += ["", "", f"# From {plain(file.name)}.", part.body]
        taken |= part.bound
        return
    function = _free(f"_effects_of_{file.stem}", taken)
    own = [result.names[cls] for cls in classes]
    for cls in classes:
        result.names[cls] = _free(result.names[cls], taken)
        taken[result.names[cls]] = taken[function] = str(file)
    result.blocks += ["", "", *_function(function, part, own, file.name), "", ""]
    result.blocks += [f"{', '.join(result.names[cls] for cls in classes)} = {function}()"]


def _function(name: str, part: Excerpt, returned: Sequence[str], file: str) -> list[str]:
    """Returns the lines of a function inside which an excerpt has names of its own."""
    doc = f'    """Returns the effects of {plain(file)}, whose names mean something else here."""'
    imports = "\n".join(import_lines(set(part.imports)))
    body = [
        *_indented(imports),
        "",
        *_indented(part.body),
        "",
        f"    return {', '.join(returned)}",
    ]
    return [f"def {name}():", doc, *body]


def _indented(text: str) -> Iterator[str]:
    """Returns lines with four more spaces in front, but not those inside of a text."""
    inside: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if tokenize.tok_name[token.type] in _TEXTS:
            inside |= set(range(token.start[0] + 1, token.end[0] + 1))
    for number, line in enumerate(text.split("\n"), start=1):
        yield f"    {line}" if line and number not in inside else line


def _free(name: str, taken: dict[str, str]) -> str:
    """Returns a name, with a number behind it if it is taken."""
    name = "".join(c if f"a{c}".isidentifier() else "_" for c in name)
    number, free = 2, name
    while free in taken:
        number, free = number + 1, f"{name}_{number}"
    return free


def _with_futures(head: str, futures: Sequence[str]) -> str:
    """Returns a file's text with imports from ``__future__``, which have to come first."""
    tree = ast.parse(head)
    body = tree.body
    present = {
        alias.name
        for statement in body
        if isinstance(statement, ast.ImportFrom) and statement.module == "__future__"
        for alias in statement.names
    }
    missing = [name for name in futures if name not in present]
    if not missing:
        return head
    lines = head.split("\n")
    has_doc = ast.get_docstring(tree) is not None
    after = (body[0].end_lineno or 0) if has_doc else 0
    return "\n".join(
        [*lines[:after], "", f"from __future__ import {', '.join(missing)}", *lines[after:]]
    )
