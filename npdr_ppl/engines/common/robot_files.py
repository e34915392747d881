"""Reads the text of an MJCF or URDF file and of those it includes, and checks what they describe.

Engines build what a file says: a few bytes can ask for a billion bodies or a height field of many
gigabytes, and an MJCF file can include any file that the user may read. Both are refused before an
engine gets the file.
"""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from npdr_ppl.errors import ModelError
from npdr_ppl.reading_limits import LIMITS

__all__ = [
    "RobotFiles",
    "asset_folders",
    "is_inside",
    "is_urdf",
    "located",
    "read_robot",
    "references",
    "relative_to",
    "urdf_mesh",
]

_ROOTS = ("mujoco", "mujocoinclude")

_COUNTS = {"actdim": 1_000, "dim": 1_000, "nsample": 10_000, "nkey": 10_000, "nuserdata": 10**6}
"""Largest values of attributes of MJCF that state how many numbers an element has."""

_STACKS = ("njmax", "nconmax", "nstack", "memory")
"""Attributes of MJCF that reserve memory, which an engine does not touch before it needs it."""

_MAX_STACK = 2**32
_MAX_USER_NUMBERS = 1_000

_NUMBER = re.compile(r"([0-9]{1,20})([kmgtpe]?)", re.ASCII | re.IGNORECASE)
_FACTORS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40, "p": 2**50, "e": 2**60}

_BLOCK = 2**16
"""Characters that are parsed at a time."""

_FOLDERS = ("assetdir", "meshdir", "texturedir")
"""Attributes of MJCF's compiler element that name folders of further files."""

_PACKAGE = "package://"

_PNG = b"\x89PNG\r\n\x1a\n"

_folder: ContextVar[Path | None] = ContextVar("folder", default=None)


@dataclass(frozen=True)
class RobotFiles:
    """The files of a robot that are text.

    Attributes:
        folder: Folder of the first file.
        texts: Texts by path relative to the folder; the first file comes first.
        trees: Their XML.
    """

    folder: Path
    texts: dict[str, str] = field(default_factory=dict)
    trees: dict[str, ElementTree.Element] = field(default_factory=dict)


@contextmanager
def relative_to(folder: Path) -> Iterator[None]:
    """Lets simulators that are made in the block look for relative paths in a folder first.

    Args:
        folder: Folder of the Python file that defines the model.
    """
    token = _folder.set(folder.absolute())
    try:
        yield
    finally:
        _folder.reset(token)


def located(source: Any) -> Any:
    """Returns the path of a robot's file; anything but a relative path is returned as it is.

    It is relative to the folder of :func:`relative_to` if it exists there, otherwise to the
    working directory.
    """
    folder = _folder.get()
    if folder is None or not isinstance(source, str | PathLike):
        return source
    return folder / source if (folder / source).is_file() else source


def read_robot(path: str | PathLike[str]) -> RobotFiles:
    """Reads a file and those that it includes, and checks that they describe a robot's size.

    Args:
        path: An MJCF or URDF file.

    Raises:
        ModelError: A file is not XML in UTF-8, includes one outside of the first one's folder, or
            describes far more than a robot has.
    """
    first = Path(path)
    files = RobotFiles(first.parent)
    _read(files, first.name, first.name)
    parts = _parts(files, first.name, {})
    if parts > LIMITS.robot_parts:
        raise ModelError(
            f"{first.name} describes {parts:.4g} parts, more than the {LIMITS.robot_parts} that "
            "a robot may have."
        )
    return files


def is_urdf(files: RobotFiles) -> bool:
    """Returns whether a robot's first file is a URDF file; ``False`` if there is no such file."""
    first = next(iter(files.trees.values()), None)
    return first is not None and first.tag == "robot"


def urdf_mesh(folder: Path, name: str, mesh_folder: str = "") -> Path | None:
    """Returns where a mesh of a URDF file is, ``None`` if it is nowhere.

    A URDF file of ROS names a mesh in a package, whose folder is usually above the file's. Other
    places are the path as it is written, the folder that an extension for MuJoCo names, and the
    file's own folder.

    Args:
        folder: Folder of the URDF file.
        name: The mesh as the file names it.
        mesh_folder: ``meshdir`` of the extension.
    """
    package, _, rest = name.removeprefix(_PACKAGE).partition("/")
    written = name.removeprefix("file://")
    places = [folder / mesh_folder / written, folder / written]
    if name.startswith(_PACKAGE):
        above = [*folder.absolute().parents, folder.absolute()]
        places = [path / rest for path in above if path.name == package]
        places.append(folder / package / rest)
    places.append(folder / Path(written).name)
    return next((place for place in places if _is_file(place)), None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # the name is too long or has a null byte
        return False


def is_inside(folder: Path, name: str) -> bool:
    """Returns whether a path relative to a folder, with its links followed, is inside it."""
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):
        return False


def _read(files: RobotFiles, name: str, includer: str) -> None:
    """Adds the text of a file, then those of the files that it includes."""
    if name in files.texts:
        return
    # The first file may be a link; only the files that it names must be beside it.
    if name != includer and not is_inside(files.folder, name):
        raise ModelError(
            f"{includer} includes {ascii(name[:80])}, which is outside of its folder; copy it "
            "into the folder."
        )
    path = files.folder / name
    if not path.is_file():
        return  # the engine says so
    if path.stat().st_size + sum(map(len, files.texts.values())) > LIMITS.json_bytes:
        raise ModelError(f"{name} has more than {LIMITS.json_bytes} bytes of text.")
    try:
        files.texts[name] = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ModelError(f"{name} is not UTF-8 text (byte {error.start}).") from None
    tree = files.trees[name] = _parsed(files.texts[name], name)
    _check(files, tree, name)
    for included in _included(tree):
        _read(files, included, name)


def _parsed(text: str, name: str) -> ElementTree.Element:
    """Returns the XML of a text, without name spaces, as the engines understand it.

    Raises:
        ModelError: It is not well-formed, or has more parts or deeper ones than a robot. Engines
            accept some texts that are not well-formed, but may see other elements in them.
    """
    # A parser keeps all attributes of an element in memory, so they are counted before it begins.
    if text.count("=") > LIMITS.robot_attributes:
        raise ModelError(f"{name} has more than {LIMITS.robot_attributes} attributes.")
    if "<!DOCTYPE" in text:
        raise ModelError(f"{name} has a DOCTYPE, which engines do not understand; remove it.")
    parser = ElementTree.XMLPullParser(("start", "end"))
    elements: list[ElementTree.Element] = []
    depth = 0
    try:
        for start in range(0, len(text), _BLOCK):
            parser.feed(text[start : start + _BLOCK])
            events: Any = parser.read_events()
            for event, element in events:
                depth += 1 if event == "start" else -1
                if event == "start":
                    element.tag = element.tag.rpartition("}")[2]
                    elements.append(element)
                if depth > LIMITS.depth or len(elements) > LIMITS.robot_parts:
                    raise ModelError(
                        f"{name} has more than {LIMITS.robot_parts} parts, or is nested more than "
                        f"{LIMITS.depth} deep."
                    )
        parser.close()
    except ElementTree.ParseError as error:
        raise ModelError(f"{name} is not well-formed XML ({error}).") from None
    return elements[0]


def _included(tree: ElementTree.Element) -> list[str]:
    """Returns the names of the files whose elements become part of an MJCF model."""
    if tree.tag not in _ROOTS:
        return []  # URDF has no includes
    # MuJoCo searches for all of them in the folder of the first file.
    elements = [*tree.iter("include"), *tree.iterfind("asset/model")]
    return [name for element in elements if (name := element.get("file"))]


def _parts(files: RobotFiles, name: str, known: dict[str, float]) -> float:
    """Returns the number of elements that a file describes, with all repetitions.

    Args:
        files: The files.
        name: The file.
        known: The numbers of other files; NaN for those that are being counted.
    """
    if name not in files.trees:
        return 1.0
    if name in known:
        if math.isnan(known[name]):
            raise ModelError(f"{name} includes itself.")
        return known[name]
    known[name] = math.nan
    tree = files.trees[name]
    models = [model.get("file", "") for model in tree.iterfind("asset/model")]

    def parts(element: ElementTree.Element) -> float:
        children = sum(map(parts, element))
        if element.tag == "replicate":
            return 1.0 + _number(element.get("count")) * children
        if element.tag in ("composite", "flexcomp"):
            return 1.0 + children + math.prod(map(_number, element.get("count", "").split()))
        if element.tag == "include":
            return _parts(files, element.get("file", ""), known)
        if element.tag == "attach":
            return sum(_parts(files, model, known) for model in models)
        return 1.0 + children

    known[name] = parts(tree) if tree.tag in _ROOTS else float(sum(1 for _ in tree.iter()))
    return known[name]


def _check(files: RobotFiles, tree: ElementTree.Element, name: str) -> None:
    """Checks the sizes that an MJCF file states."""
    if tree.tag not in _ROOTS:
        for place in asset_folders(tree):
            for reference in references(tree):
                if (found := urdf_mesh(files.folder, reference, place)) is not None:
                    _check_mesh(found)
        return
    for reference in references(tree):
        _check_mesh(files.folder / reference)
    folders = [files.folder / compiler.get("texturedir", "") for compiler in tree.iter("compiler")]
    for element in tree.iter():
        for word, value in element.items():
            limit = _COUNTS.get(word, _MAX_STACK if word in _STACKS else None)
            if element.tag == "size" and limit is None:
                limit = _MAX_USER_NUMBERS
            if limit is not None and _number(value) > limit:
                raise ModelError(
                    f"{name} has {word}={ascii(value[:30])}, more than the {limit} of a robot."
                )
        width, height = _number(element.get("width")), _number(element.get("height"))
        if element.tag == "texture" and element.get("type", "cube") != "2d":
            height = max(height, 6 * width)  # a face for each side of the cube
        pixels = max(width * height, _number(element.get("nrow")) * _number(element.get("ncol")))
        if picture := element.get("file", ""):
            pixels = max(pixels, *(_pixels(f / picture) for f in (files.folder, *folders)))
        if 4 * pixels > LIMITS.free_bytes:
            raise ModelError(
                f"{name} has a picture or height field of {pixels:.4g} points, more than "
                f"{LIMITS.free_bytes // 4}."
            )


def asset_folders(tree: ElementTree.Element) -> list[str]:
    """Returns the folders in which a file's assets may be, relative to its own; that one first."""
    found = [compiler.get(name, "") for compiler in tree.iter("compiler") for name in _FOLDERS]
    return list(dict.fromkeys(["", *found]))


def references(tree: ElementTree.Element) -> Iterator[str]:
    """Yields the names of referenced files other than included ones."""
    for element in tree.iter():
        name = element.get("file") or element.get("filename")
        if name and element.tag != "include":
            yield name


def _check_mesh(path: Path) -> None:
    """Checks a file that an engine reads as a whole; Bullet does not check the size in an STL."""
    try:
        if not path.is_file():
            return
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(84)
    except (OSError, ValueError):
        return  # the engine says so
    if size > LIMITS.free_bytes:
        raise ModelError(f"{path.name} has more than {LIMITS.free_bytes} bytes.")
    is_binary_stl = path.suffix.lower() == ".stl" and not head.startswith(b"solid")
    if is_binary_stl and size != 84 + 50 * int.from_bytes(head[80:], "little"):
        raise ModelError(f"{path.name} has more or fewer faces than it says.")


def _pixels(path: Path) -> float:
    """Returns the number of pixels of a PNG file; 0 for any other file."""
    try:
        if not path.is_file():
            return 0.0
        with path.open("rb") as file:
            head = file.read(24)
    except (OSError, ValueError):
        return 0.0
    is_png = len(head) == 24 and head.startswith(_PNG)
    return float(int.from_bytes(head[16:20]) * int.from_bytes(head[20:24])) if is_png else 0.0


def _number(text: str | None) -> float:
    """Returns a whole number, with a unit of memory if it has one; 0 for any other text."""
    found = _NUMBER.fullmatch((text or "").strip())
    return float(found[1]) * _FACTORS[found[2].lower()] if found else 0.0
