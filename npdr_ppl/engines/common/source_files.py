"""Records the files that describe a robot, so that a run can be repeated after they change."""

import hashlib
import importlib
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.engines.common.robot_files import is_inside, read_robot, references
from npdr_ppl.reading_limits import LIMITS

__all__ = ["recorded_files", "recorded_mjcf"]

OUTSIDE = "not recorded: outside of the folder of the description"
"""What is recorded of an asset that is neither in the robot's folder nor below it."""

# Attributes of MJCF's compiler element that name folders of further files.
_FOLDERS = ("assetdir", "meshdir", "texturedir")


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
    folders = [""]
    for tree in files.trees.values():
        for compiler in tree.iter("compiler"):
            folders += [compiler.get(name, "") for name in _FOLDERS]
    names = {name for tree in files.trees.values() for name in references(tree)}
    assets = {name: _digest(files.folder, name, folders) for name in sorted(names)}
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


def _digest(folder: Path, name: str, places: list[str]) -> str | None:
    for place in places:
        file = folder / place / name
        if not file.is_file() or file.stat().st_size > LIMITS.file_bytes:
            continue
        if not is_inside(folder, str(Path(place) / name)):
            return OUTSIDE
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    return None
