"""Records the files that describe a robot, so that a run can be repeated after they change."""

import hashlib
import importlib
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

__all__ = ["recorded_files", "recorded_mjcf"]

# Attributes of MJCF's compiler element that name folders of further files.
_FOLDERS = ("assetdir", "meshdir", "texturedir")


def recorded_files(source: str | PathLike[str]) -> dict[str, Any]:
    """Returns the text of an MJCF or URDF file and of those it includes, for JSON.

    Args:
        source: Path of the file.

    Returns:
        ``file``: its name; ``text``: texts of this file and included files, by path relative to
        its folder; ``assets``: SHA-256 of other files such as meshes, ``None`` if not found.
    """
    path = Path(source)
    texts: dict[str, str] = {}
    _read(path.parent, path.name, texts)
    trees = [tree for text in texts.values() if (tree := _parsed(text)) is not None]
    folders = [path.parent]
    for tree in trees:
        for compiler in tree.iter("compiler"):
            folders += [path.parent / compiler.get(name, "") for name in _FOLDERS]
    assets = {name: _digest(name, folders) for tree in trees for name in _references(tree)}
    return {"file": path.name, "text": texts, "assets": dict(sorted(assets.items()))}


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


def _read(folder: Path, name: str, texts: dict[str, str]) -> None:
    """Adds the text of a file, then those of the files that it includes."""
    path = folder / name
    if name in texts or not path.is_file():
        return
    texts[name] = path.read_text(errors="replace")
    tree = _parsed(texts[name])
    if tree is not None:
        for include in tree.iter("include"):
            # MuJoCo searches for all of them in the folder of the first file.
            _read(folder, include.get("file", ""), texts)


def _parsed(text: str) -> ElementTree.Element | None:
    """Returns the XML of a text, or ``None``: an engine may accept text that is not valid XML."""
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return None


def _references(tree: ElementTree.Element) -> Iterator[str]:
    """Yields the names of referenced files other than included ones."""
    for element in tree.iter():
        name = element.get("file") or element.get("filename")
        if name and element.tag != "include":
            yield name


def _digest(name: str, folders: list[Path]) -> str | None:
    for folder in folders:
        file = folder / name
        if file.is_file():
            return hashlib.sha256(file.read_bytes()).hexdigest()
    return None
