"""Fits of an interrupted discovery, kept on disk so that the next run does not repeat them.

Fits take most of a search's time, and are deterministic. Inside a block of :func:`keep_fits`, each
finished fit is written to a file whose name is a checksum of all that the fit depends on. The same
search then reads it, takes the same decisions, and gives the same result. Changes in installed
modules that a model imports are not noticed; delete the folder of fits after such a change.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.model_identity import source_text, versions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.run_files import load_tensors, make_folder, save_tensors

__all__ = ["keep_fits", "keeping", "made_or_read"]

Item = TypeVar("Item")
Result = TypeVar("Result")

VERSION = 11
"""Raised when fits end elsewhere than before, so that those of earlier versions are not read."""

_KEPT: ContextVar[tuple[Path | None, str]] = ContextVar("kept_fits", default=(None, ""))
"""The folder of fits, and the checksum of the model's code."""


@contextmanager
def keep_fits(folder: Path | None, code: str = "") -> Iterator[None]:
    """Writes each fit inside the block to a folder, and reads those that are there.

    Args:
        folder: The folder, which is created if there is none; nothing is kept if it is ``None``.
        code: Checksum of the model's code; see :func:`npdr_ppl.model_code.code_checksum`. Fits of
            other code in the folder are not read.
    """
    token = _KEPT.set((folder, code))
    try:
        yield
    finally:
        _KEPT.reset(token)


def keeping(function: Callable[[Item], Result]) -> Callable[[Item], Result]:
    """Returns a function that keeps its fits in this process's folder, in any process."""
    return partial(_kept, function, *_KEPT.get())


def _kept(
    function: Callable[[Item], Result], folder: Path | None, code: str, item: Item
) -> Result:
    with keep_fits(folder, code):
        return function(item)


def made_or_read(
    make: Callable[[], dict[str, Tensor]],
    segments: SegmentModel,
    *rest: Any,
) -> dict[str, Tensor]:
    """Returns tensors from disk, or computes them and writes them to disk.

    Args:
        make: Makes the tensors, by name.
        segments: The model and the recording.
        rest: What else the tensors depend on: other tensors, or values with a ``repr``.

    Raises:
        OSError: The tensors cannot be written.
    """
    folder, code = _KEPT.get()
    if folder is None:
        return make()
    file = folder / f"{_checksum(segments, code, *rest)[:32]}.safetensors"
    with suppress(DataError):  # there are none, or the file is damaged
        return load_tensors(file)
    made = make()
    make_folder(folder)
    save_tensors(file, made)
    return made


def _checksum(segments: SegmentModel, *rest: Any) -> str:
    """Returns a checksum of all that tensors depend on."""
    simulator, prior = segments.simulator, segments.prior
    # The priors, by their values at some points: not every distribution can be printed.
    points = torch.linspace(-2.0, 2.0, 5).double()[:, None].expand(-1, prior.num_parameters)
    parameters = prior.to_parameters(points)
    parts = [
        VERSION,
        versions(),
        source_text(segments.model),
        segments.channel_names,
        type(simulator).__qualname__,
        simulator.recorded_settings(),
        *parameters,
        *parameters.values(),
        *(getattr(segments.inputs, field.name) for field in fields(segments.inputs)),
        segments.observed,
        *rest,
    ]
    digest = hashlib.sha256()
    for part in parts:
        is_tensor = isinstance(part, Tensor)
        digest.update(part.contiguous().numpy().tobytes() if is_tensor else repr(part).encode())
    return digest.hexdigest()
