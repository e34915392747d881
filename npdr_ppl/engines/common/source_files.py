"""Records the files that describe a robot, so that a run can be repeated after they change."""

import hashlib
import importlib
import os
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.engines.common.robot_files import (
    asset_folders,
    is_inside,
    is_urdf,
    read_robot,
    references,
    urdf_mesh,
)
from npdr_ppl.reading_limits import LIMITS

__all__ = ["recorded_files", "recorded_mjcf"]

OUTSIDE = "not recorded: outside of the folder of the description"
"""What is recorded of an asset that is neither in the robot's folder nor below it."""


def recorded_files(source: str | PathLike[str]) -> dict[str, Any]:
    """Returns the text of an MJCF or URDF file and of those it includes, for JSON.

    Args:
        source: Path of the file.

    Returns:
        ``file``: its name; ``text``: texts of this file and included files, by path relative to
        its folder; ``assets``: SHA-256 of other files such as meshes, :data:`OUTSIDE` for those
        elsewhere, ``None`` if not found.

    Raises:
        ModelError: A file outside of the folder is included; see :func:`read_robot`.
    """
    files = read_robot(source)
    folders = [place for tree in files.trees.values() for place in asset_folders(tree)]
    names = {name for tree in files.trees.values() for name in references(tree)}
    find = urdf_mesh if is_urdf(files) else _found
    assets = {
        name: _digest(files.folder, [find(files.folder, name, place) for place in folders])
        for name in sorted(names)
    }
    return {"file": Path(source).name, "text": files.texts, "assets": assets}


def recorded_mjcf(source: Any) -> dict[str, Any]:
    """Returns the result of :func:`recorded_files`, or only the SHA-256 of a ``mujoco.MjModel``.

    A compiled model does not contain the text from which it was made.

    Args:
        source: Path of an MJCF file, or a ``mujoco.MjModel``.
    """
    if isinstance(source, str | PathLike):
        return recorded_files(source)
    mujoco: Any = importlib.import_module("mujoco")
    compiled = np.zeros(mujoco.mj_sizeModel(source), dtype=np.uint8)
    mujoco.mj_saveModel(source, None, compiled)
    return {"file": None, "model_sha256": hashlib.sha256(compiled.tobytes()).hexdigest()}


def _found(folder: Path, name: str, place: str) -> Path | None:
    """Returns an asset of an MJCF file in one of its folders; ``None`` if it is not there."""
    file = folder / place / name
    return file if file.is_file() else None


def _digest(folder: Path, places: Iterable[Path | None]) -> str | None:
    for file in places:
        if file is None or file.stat().st_size > LIMITS.file_bytes:
            continue
        if not is_inside(folder, os.path.relpath(file, folder)):
            return OUTSIDE
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    return None
