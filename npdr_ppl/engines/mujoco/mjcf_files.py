"""The text of robots' files, and models from changed text."""

import tempfile
from pathlib import Path
from typing import Any
from uuid import uuid4
from xml.etree import ElementTree

from npdr_ppl.engines.common.robot_files import RobotFiles, is_urdf, references
from npdr_ppl.engines.mujoco.base_parameters import load_mjcf
from npdr_ppl.engines.mujoco.mjcf_text import flattened
from npdr_ppl.engines.mujoco.urdf_files import as_mjcf
from npdr_ppl.errors import ModelError

__all__ = ["folder_of_assets", "mjcf_text", "reloaded"]


def mjcf_text(file: Path, files: RobotFiles) -> str:
    """Returns the MJCF text of a robot's file; of a URDF file, what MuJoCo makes of it.

    Args:
        file: Path of the file.
        files: The same, as it was read.
    """
    return as_mjcf(file) if is_urdf(files) else flattened(files).decode()


def folder_of_assets(file: Path, files: RobotFiles) -> Path | None:
    """Returns the folder in which a robot's MJCF text finds meshes; ``None`` if it has none.

    Args:
        file: Path of the file.
        files: The same, as it was read.
    """
    # Of a URDF file, meshes that were not found are left out.
    trees = [ElementTree.fromstring(as_mjcf(file))] if is_urdf(files) else files.trees.values()
    return file.parent if any(True for tree in trees for _ in references(tree)) else None


def reloaded(text: str, ending: str, folder: Path | None) -> Any:
    """Returns the model of a file that was written, as the engine reads it.

    Args:
        text: The file's text.
        ending: ``".xml"`` or ``".urdf"``.
        folder: Folder that has the meshes; ``None`` if there are none.

    Raises:
        ModelError: The engine cannot read it.
    """
    with tempfile.TemporaryDirectory() as own:
        path = (folder or Path(own)) / f".npdr-{uuid4().hex}{ending}"
        try:
            path.write_text(text, encoding="utf-8")
            return load_mjcf(path)
        except ModelError as error:
            raise ModelError(str(error).replace(str(path), "The new text")) from None
        except OSError as error:
            raise ModelError(f"The new text needs a file in {path.parent}: {error}.") from error
        finally:
            path.unlink(missing_ok=True)
