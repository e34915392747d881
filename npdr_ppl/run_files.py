"""Files in a run's folder: JSON, tensors, and the description that identifies the run."""

import functools
import inspect
import json
import math
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from pyro.poutine.messenger import Messenger
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from npdr_ppl.atomic_files import remove_leftovers, replacing
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import ModelWithEffects, ModelWithFinerSteps
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.language.wider_priors import ModelWithWiderPriors

__all__ = [
    "claimed",
    "engine_settings",
    "holds_this_run",
    "load_tensors",
    "make_folder",
    "plain",
    "read_json",
    "save_tensors",
    "source_text",
    "versions",
    "write_json",
]

LOCK = ".lock"
"""Name of the file in a folder of results that the process which uses the folder has locked."""

IN_WORDS = {
    "binding": "how the data are prepared",
    "fingerprint": "the data or what is read from them",
    "model": "the model's source",
    "num_simulations": "the number of simulations",
    "num_steps": "the number of steps",
}
"""Plain words for the keys of a run's description, for messages to the user."""

_PACKAGES = ("npdr-ppl", "torch", "pyro-ppl", "zuko", "numpy", "arviz")


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
        remove_leftovers(path)
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
    words = ", ".join(dict.fromkeys(IN_WORDS.get(key, key) for key in differing))
    raise DataError(
        f"{file.parent} holds a run that differs in {words}; choose another folder, or remove it."
    )


def _differing(present: Mapping[str, Any], wanted: Mapping[str, Any]) -> Iterator[str]:
    """Yields the keys whose values differ; those of the options in place of ``options``."""
    for key, value in wanted.items():
        known = present.get(key)
        if key == "options" and isinstance(known, Mapping):
            yield from (k for k in {**known, **value} if known.get(k) != value.get(k))
        elif known != value:
            yield key


def write_json(path: Path, value: Any) -> None:
    """Writes JSON atomically."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        DataError: The file is not JSON.
    """
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is not readable JSON: {error}.") from error
    if not isinstance(value, dict):
        raise DataError(f"{path} should hold a JSON object.")
    return value


def versions() -> dict[str, str]:
    """Returns the versions that a result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def source_text(model: Any) -> str:
    """Returns the source of a model, and the names of what is attached to it."""
    if isinstance(model, ModelWithEffects):
        attached = "\n".join(f"# with {effect!r}" for effect, _ in model.effects)
        return f"{source_text(model.base)}\n{attached}"
    if (
        isinstance(model, functools.partial)
        and model.args
        and isinstance(model.args[0], Messenger)
    ):
        # Pyro wraps a model in a handler by a partial that has both as arguments.
        return f"{source_text(model.args[-1])}\n# under {type(model.args[0]).__name__}"
    if isinstance(model, ModelWithFinerSteps | ModelWithWiderPriors):
        return f"{source_text(model.base)}\n# {model!r}"
    try:
        return inspect.getsource(model)
    except (OSError, TypeError):
        return repr(model)


def engine_settings(prior: Prior) -> dict[str, Any]:
    """Returns the settings of the simulators' engines by site, without empty ones."""
    settings = {
        name: box.simulator.recorded_settings()
        for name, box in prior.black_boxes.items()
        if isinstance(box, SimulatorBlackBox)
    }
    return {name: values for name, values in settings.items() if values}


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
    """Writes tensors atomically."""
    content = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Reads tensors.

    Raises:
        DataError: The file is not safetensors.
    """
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise DataError(f"{path} is not a readable safetensors file: {error}.") from error
