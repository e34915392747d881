"""Turns the words of --effect and --candidates into effects.

A word names an effect of the catalogue, ``port.effect``, or a class in a Python file,
``path/to/file.py:Class@port``. Without ``:Class`` the file has to define one effect.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from npdr_ppl.cli.model_files import load_relative
from npdr_ppl.errors import ModelError
from npdr_ppl.python_files import check_exists, is_importable

if TYPE_CHECKING:
    from npdr_ppl.language.effects import Effect

__all__ = ["named_effects", "split_effects"]

_IN_FILE = re.compile(r"(?P<path>.+?\.py)(?::(?P<name>[^@]*))?(?:@(?P<port>.*))?")


def named_effects(words: Sequence[str]) -> "list[Effect]":
    """Returns the effects that words name; a word may hold several, separated by commas.

    Raises:
        ModelError: There is no such effect or file.
    """
    from npdr_ppl.models.effects import effects

    catalogue = effects()
    found = []
    for word in (part for text in words for part in split_effects(text, catalogue)):
        if _IN_FILE.fullmatch(word):
            found.append(_effect_in_file(word, catalogue))
            continue
        port, separator, name = word.rpartition(".")
        if not separator or name not in catalogue:
            close = get_close_matches(name, catalogue, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(catalogue)}."
            if not separator and word in catalogue:
                hint = f"say where it attaches, as in JOINT.{word}."
            raise ModelError(
                f"{word!r} is neither port.effect with an effect of `npdr effects` nor "
                f"path/to/file.py:Class@port; {hint}"
            )
        found.append(catalogue[name](port))
    return found


def split_effects(text: str, known: Collection[str]) -> list[str]:
    """Splits at commas that follow an effect; the name of a port may itself contain commas.

    The port of an effect in a file comes last. It ends where another effect begins, so that
    ``file.py:Law@angle,velocity`` is one effect and ``file.py:Law@hinge,hinge.bias`` are two.

    Args:
        text: One or several effects.
        known: Ids of the effects that ``port.effect`` may name.
    """
    parts = [""]
    for piece in map(str.strip, text.split(",")):
        begins = _is_complete(parts[-1], known)
        if _IN_FILE.fullmatch(parts[-1]):
            begins = _is_complete(piece, known)
        if begins:
            parts.append(piece)
        else:
            parts[-1] = f"{parts[-1]},{piece}".lstrip(",")
    return parts


def _is_complete(part: str, known: Collection[str]) -> bool:
    """Returns whether a part of a text is an effect by itself."""
    return part.rpartition(".")[2] in known or _IN_FILE.fullmatch(part) is not None


def _effect_in_file(word: str, catalogue: "Mapping[str, type[Effect]]") -> "Effect":
    """Returns the effect that ``path/to/file.py:Class@port`` names."""
    from npdr_ppl.models.effects.effect_files import effect_of

    match = _IN_FILE.fullmatch(word)
    assert match is not None
    path, name, port = Path(match["path"]), match["name"] or "", match["port"] or ""
    check_exists(path, "*.py", word.removeprefix(match["path"]))
    cls = effect_of(load_relative(path), path, name)
    known = catalogue.get(cls.id)
    # Results name effects by id. The user's own copy among the added files is the same effect.
    if known is not None and is_importable(known.__module__):
        raise ModelError(
            f"{path}:{cls.__name__} has the id {cls.id!r} of another effect of `npdr effects`; "
            f"change the id, or use {port or 'PORT'}.{cls.id}."
        )
    if not port:
        kinds = " or ".join(cls.port_kinds)
        raise ModelError(
            f"{word!r} does not say where the effect attaches; {cls.__name__} attaches to a port "
            f"of kind {kinds}: write {path}:{cls.__name__}@PORT."
        )
    return cls(port)
