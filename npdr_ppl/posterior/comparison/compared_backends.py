"""What is compared: backends with options, under labels of their own.

A candidate is written as its backend's name, with options in parentheses and a label in front
where they are wanted::

    snpe-c
    snpe-c(flow=maf, members=1)
    small = snpe-c(hidden=(32, 32), embedding=all/10)

``embedding`` is an option of every candidate: the features it conditions on, if not those of all.
"""

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from npdr_ppl.embeddings import Embedding, embedding_by_name
from npdr_ppl.errors import BackendError
from npdr_ppl.inference.base import Backend
from npdr_ppl.inference.registry import backend as backend_by_name

__all__ = [
    "Backends",
    "Candidate",
    "available",
    "candidate",
    "candidates",
    "folder_name",
    "name_and_options",
    "requested",
    "split_candidates",
]


@dataclass(frozen=True)
class Candidate:
    """A backend of a comparison, with its options and features.

    Attributes:
        backend: The backend with its options.
        embedding: The features from which it infers; ``None`` for those of the comparison.
    """

    backend: Backend
    embedding: str | Embedding | None = None

    @property
    def is_sequential(self) -> bool:
        """Whether it makes use of several rounds."""
        return self.backend.is_sequential


Backends = Sequence[str | Backend | Candidate] | Mapping[str, str | Backend | Candidate]
"""Backends to compare: a sequence, in which names or texts are the labels; or a mapping by
label."""


def candidates(backends: Backends) -> dict[str, Candidate]:
    """Returns candidates by label.

    Raises:
        BackendError: There are none, a label occurs twice, or a backend or option does not exist.
    """
    found: dict[str, Candidate] = {}
    if isinstance(backends, Mapping):
        pairs = [(str(label), _labelled(value)[1]) for label, value in backends.items()]
    else:
        pairs = [_labelled(value) for value in backends]
    for label, named in pairs:
        taken = {folder_name(known): known for known in found}
        if folder_name(label) in taken:
            raise BackendError(
                f"The labels {taken[folder_name(label)]!r} and {label!r} cannot be told apart; "
                "write a label in front, as in 'other = snpe-c(flow=maf)'."
            )
        found[label] = named
    if not found:
        raise BackendError("Name at least one backend to compare.")
    return found


def candidate(text: str) -> Candidate:
    """Returns the candidate that a text without a label describes, e.g. ``snpe-c(flow=maf)``.

    Raises:
        BackendError: The backend, its features or an option does not exist.
    """
    name, options = name_and_options(text)
    embedding = options.pop("embedding", None)
    if embedding not in (None, "score"):
        embedding_by_name(embedding)  # says so now if there is none of this name
    try:
        method = backend_by_name(name, **options)
    except TypeError as error:
        raise BackendError(
            f"{text.strip()!r} has an option of the wrong type: {error}."
        ) from error
    return Candidate(method, embedding)


def split_candidates(text: str) -> list[str]:
    """Splits the texts of candidates at commas, as they are written on a command line.

    Raises:
        BackendError: Parentheses do not match.
    """
    return [part for part in _split(text, ",") if part]


def available(texts: Mapping[str, str]) -> tuple[dict[str, Candidate], dict[str, str]]:
    """Returns the usual candidates whose backends are installed.

    Args:
        texts: Candidates' texts by label.

    Returns:
        The candidates by label, and for each other one a sentence that says why it is left out.
    """
    found: dict[str, Candidate] = {}
    skipped: dict[str, str] = {}
    for label, text in texts.items():
        try:
            found |= candidates({label: text})
        except BackendError as error:
            skipped[label] = str(error)
    return found, skipped


def requested(
    texts: Sequence[str] | None, usual: Mapping[str, str]
) -> tuple[dict[str, Candidate], dict[str, str]]:
    """Returns the requested candidates; usual ones can be requested by their labels.

    Args:
        texts: Labels of usual candidates, or texts of candidates; ``None`` for all usual ones
            whose backends are installed.
        usual: Texts of the usual candidates by label.

    Returns:
        The candidates by label, and for each usual one that is left out a sentence that says why.

    Raises:
        BackendError: No candidate was requested, or one twice, or one that does not exist.
    """
    if texts is None:
        return available(usual)
    return candidates([f"{t} = {usual[t]}" if t in usual else t for t in texts]), {}


def folder_name(label: str) -> str:
    """Returns a label as the name of a folder."""
    return re.sub(r"[^\w.+=-]+", "_", label).strip("_.")


def _labelled(value: str | Backend | Candidate) -> tuple[str, Candidate]:
    if isinstance(value, Candidate):
        return value.backend.name, value
    if isinstance(value, Backend):
        return value.name, Candidate(value)
    label, _, rest = value.rpartition("=") if "(" not in value else _label(value)
    return label.strip() or rest.strip(), candidate(rest)


def _label(text: str) -> tuple[str, str, str]:
    """Splits at the last ``=`` in front of the options."""
    head, bracket, tail = text.partition("(")
    label, separator, name = head.rpartition("=")
    return label, separator, name + bracket + tail


def name_and_options(text: str) -> tuple[str, dict[str, Any]]:
    """Splits ``name(option=value, ...)`` into the name and its options.

    Raises:
        BackendError: Parentheses do not match, or something is not an option with a value.
    """
    name, bracket, inside = text.strip().partition("(")
    if not bracket:
        return name, {}
    if not inside.endswith(")"):
        raise BackendError(f"{text.strip()!r} should end with a closing parenthesis.")
    options: dict[str, Any] = {}
    for part in _split(inside[:-1], ","):
        option, separator, value = part.partition("=")
        if not separator or not option.strip() or not value.strip():
            raise BackendError(f"{text.strip()!r} has {part!r} where option=value is expected.")
        options[option.strip()] = _value(value.strip())
    return name.strip(), options


def _value(text: str) -> Any:
    """Reads a Python literal; anything else is a word."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def _split(text: str, separator: str) -> list[str]:
    """Splits at a separator outside of all brackets."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "([") - (character in ")]")
        if depth < 0:
            raise BackendError(f"{text!r} closes a parenthesis that it did not open.")
        if character == separator and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    if depth:
        raise BackendError(f"{text!r} leaves a parenthesis open.")
    return [part.strip() for part in parts]
