"""Files in a run's folder: JSON, tensors, and the check that a folder holds this run."""

import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch
from filelock import FileLock, Timeout
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from npdr_ppl.atomic_files import remove_unfinished, replacing
from npdr_ppl.errors import DataError, NpdrError
from npdr_ppl.reading_limits import LIMITS

__all__ = [
    "claimed",
    "holds_this_run",
    "load_tensors",
    "make_folder",
    "plain",
    "read_bytes",
    "read_json",
    "read_text",
    "reading_back",
    "save_tensors",
    "write_json",
]

LOCK = ".lock"
"""Name of the file in a folder of results that the process which uses the folder has locked."""

IN_WORDS = {
    "binding": "how the data are prepared",
    "code": "the model's code or a file that it names",
    "features": "what is read from the data or the model",
    "fingerprint": "the data",
    "name": "the model's name, or what is attached to it",
    "num_simulations": "the number of simulations",
    "num_steps": "the number of steps",
}
"""Plain words for the keys of a run's description, for messages to the user."""

MAX_WHOLE_NUMBER = 2**63
"""Largest absolute whole number in a file; seeds have at most 63 bits."""

ROUNDING = 1e-6
"""Difference up to which computed values of a run's description are the same. It is far above
rounding errors and far below what other data or another model change."""

_CHECKSUM = "sha256"

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x1f\x7f-\x9f]")
"""Characters that could change a terminal's state; source code has none of them."""

T = TypeVar("T")


def make_folder(path: Path) -> None:
    """Makes a folder for results if there is none.

    Raises:
        DataError: A file exists at the path or above it.
    """
    for place in (path, *path.parents):
        if place.exists():
            if not place.is_dir():
                raise DataError(f"{path} cannot be a folder for results: {place} is a file.")
            break
    path.mkdir(parents=True, exist_ok=True)


@contextmanager
def claimed(path: Path | None) -> Iterator[None]:
    """Makes a folder for results, and keeps other processes from writing to it in the block.

    Args:
        path: The folder; nothing is done if it is ``None``.

    Raises:
        DataError: Another process uses the folder, or it cannot be written to.
    """
    if path is None:
        yield
        return
    make_folder(path)
    # One lock per path, so that blocks of the same process may be nested.
    lock = FileLock(path / LOCK, timeout=0, is_singleton=True)
    owner = _owner(path)
    try:
        lock.acquire()
    except Timeout:
        raise DataError(
            f"{path} is in use by {owner}; wait until it has ended, or choose another folder."
        ) from None
    try:
        (path / LOCK).write_text(str(os.getpid()))
        if lock.lock_counter == 1:
            remove_unfinished(path)
        yield
    finally:
        lock.release()


def _owner(path: Path) -> str:
    """Returns the process that uses a folder, in words."""
    try:
        number = (path / LOCK).read_text().strip()
    except OSError:
        number = ""
    return f"process {number}" if number.isdecimal() else "another process"


def holds_this_run(file: Path, description: Mapping[str, Any]) -> bool:
    """Returns whether a folder already describes this run.

    The description of another run that has no results yet is ignored, so that a user can correct
    an error and give the command again.

    Args:
        file: JSON with the description, which is not written here.
        description: Description of the run that is about to start.

    Raises:
        DataError: The folder holds results of another run.
    """
    if not file.exists():
        return False
    present = read_json(file)
    differing = list(_differing(present, plain(description)))
    if not differing:
        return True
    inputs = {file, file.parent / LOCK, *file.parent.glob("data_*")}
    if not any(entry not in inputs for entry in file.parent.iterdir()):
        return False
    # An edited file can have keys of any text.
    names = (IN_WORDS.get(key, shown_sentence(key, 40)) for key in differing)
    words = ", ".join(dict.fromkeys(names))
    raise DataError(
        f"{file.parent} holds a run that differs in {words}; choose another folder, or remove it."
    )


def _differing(present: Mapping[str, Any], wanted: Mapping[str, Any]) -> Iterator[str]:
    """Yields the keys whose values differ; those of the options in place of ``options``."""
    for key, value in wanted.items():
        known = present.get(key)
        if key == "options" and isinstance(known, Mapping):
            yield from (k for k in {**known, **value} if known.get(k) != value.get(k))
        elif not _is_same(known, value):
            yield key


def _is_same(known: Any, value: Any) -> bool:
    """Returns whether values are equal; computed ones, lists of floats, up to rounding."""
    if isinstance(known, list) and isinstance(value, list) and len(known) == len(value):
        pairs = list(zip(known, value, strict=True))
        if all(isinstance(one, float) and isinstance(other, float) for one, other in pairs):
            return all(math.isclose(*pair, rel_tol=ROUNDING, abs_tol=ROUNDING) for pair in pairs)
    return bool(known == value)


def write_json(path: Path, value: Any) -> None:
    """Writes JSON atomically."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def read_json(path: Path, kind: type[T] = dict[str, Any]) -> T:
    """Reads a JSON object.

    Args:
        path: The file.
        kind: What it holds, such as a class of :mod:`npdr_ppl.run_records`; keys that the class
            does not have are kept.

    Raises:
        DataError: The file is not JSON, or holds something else.
    """
    content = read_bytes(path)
    # Texts may contain some of these characters, too.
    if sum(map(content.count, (b",", b"[", b"{"))) > 4 * LIMITS.json_values:
        raise DataError(f"{path} has too many values or separators for a file of npdr.")
    try:
        value: Any = msgspec.json.decode(content)
        _check_plain(value)
        msgspec.convert(value, kind)
    except (msgspec.ValidationError, DataError) as error:
        reason = str(error).replace("`", "").rstrip(".")
        raise DataError(f"{path} is not what npdr writes: {shown_sentence(reason)}.") from None
    except (ValueError, RecursionError) as error:
        reason = "too deeply nested" if isinstance(error, RecursionError) else str(error)
        raise DataError(f"{path} is not readable JSON: {shown_sentence(reason)}.") from None
    return value


def read_text(path: Path) -> str:
    """Reads a text such as a model's source.

    Raises:
        DataError: The file is too large, or is not UTF-8.
    """
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not UTF-8 text (byte {error.start}).") from None


def read_bytes(path: Path, limit: int = LIMITS.json_bytes) -> bytes:
    """Reads a file of a run.

    Args:
        path: The file.
        limit: Largest size in bytes.

    Raises:
        DataError: The file is larger, is not a regular file, or cannot be read.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{path} is not a regular file.")
        if status.st_size > limit:
            raise DataError(f"{path} has {status.st_size} bytes, more than {limit}.")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}).") from error


@contextmanager
def reading_back(path: Path) -> Iterator[None]:
    """Turns errors about the content of files that were read from a folder into one sentence.

    The types of the content are checked when it is read; this is for values and shapes that do
    not fit each other.

    Args:
        path: The file or folder, for the message.

    Raises:
        DataError: The block failed.
    """
    try:
        yield
    except NpdrError:
        raise
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        reason = shown_sentence(f"{type(error).__name__}: {error}")
        raise DataError(f"{path} is not what npdr writes ({reason}).") from error


def shown_sentence(text: str, limit: int = 200) -> str:
    """Returns the first sentence of a library's message, without its end, on one line."""
    line = re.split(r"\.\s+(?=[A-Z])", " ".join(text.split()))[0].rstrip(".")
    line = line if line.isprintable() else ascii(line)
    return line if len(line) <= limit else f"{line[:limit]}…"


def _check_plain(value: Any) -> None:
    """Checks size, depth, numbers and texts of a JSON value.

    Raises:
        DataError: It is nested too deeply, or has a number or a text that npdr never writes.
    """
    layer, count = [value], 0
    for _ in range(LIMITS.depth):
        count += len(layer)
        if count > LIMITS.json_values:
            raise DataError(f"it has more than {LIMITS.json_values} values")
        below: list[Any] = []
        for item in layer:
            if isinstance(item, dict):
                below += [*item, *item.values()]
            elif isinstance(item, list):
                below += item
            elif isinstance(item, str) and not item.isprintable() and _CONTROL.search(item):
                raise DataError("a text has control characters")
            elif isinstance(item, int) and abs(item) > MAX_WHOLE_NUMBER:
                raise DataError("a whole number is too large")
        if not below:
            return
        layer = below
    raise DataError(f"it is nested more than {LIMITS.depth} deep")


def plain(value: Any) -> Any:
    """Turns tensors, tuples and mappings into JSON types; NaN and infinity become null."""
    if isinstance(value, Tensor):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if hasattr(value, "item") and not isinstance(value, str):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Writes tensors atomically, with a checksum."""
    kept = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    content = save(kept, metadata={_CHECKSUM: _checksum(kept)})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def load_tensors(path: Path, *names: str) -> dict[str, Tensor]:
    """Reads tensors.

    Args:
        path: The file.
        names: Tensors that must be there.

    Raises:
        DataError: The file is not safetensors, lacks a tensor, or was changed.
    """
    content = read_bytes(path, LIMITS.file_bytes)
    try:
        tensors = load(content)
        length = int.from_bytes(content[:8], "little")
        header = msgspec.json.decode(content[8 : 8 + length], type=_TensorHeader)
    except (SafetensorError, ValueError, LookupError, RecursionError, RuntimeError) as error:
        reason = shown_sentence(str(error))
        raise DataError(f"{path} is not a readable safetensors file: {reason}.") from error
    if header.metadata.get(_CHECKSUM) != _checksum(tensors):
        raise DataError(f"{path} was changed after npdr wrote it, or by another version.")
    for name in names:
        if name not in tensors:
            raise DataError(f"{path} lacks {name}.")
    return tensors


class _TensorHeader(msgspec.Struct):
    """The part of a safetensors header that is read here."""

    metadata: dict[str, str] = msgspec.field(name="__metadata__", default_factory=dict)


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """Returns the SHA-256 of tensors with their names, types and shapes."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(repr((name, str(tensor.dtype), tuple(tensor.shape))).encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
