"""Changes attributes of elements in the text of an MJCF file, and leaves all the rest as it is."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

from npdr_ppl.engines.common.robot_files import RobotFiles
from npdr_ppl.errors import ModelError

__all__ = ["MjcfText", "Tag", "flattened"]


@dataclass(frozen=True)
class Tag:
    """The start tag of an element.

    Attributes:
        name: The element's name.
        attributes: Its attributes as they are written.
        start: Place of its first byte.
        end: Place behind its last byte.
        parents: Names of the elements around it, the outermost first.
        parent: Number of the tag of the element around it; -1 for the outermost.
    """

    name: str
    attributes: Mapping[str, str]
    start: int
    end: int
    parents: tuple[str, ...]
    parent: int


@dataclass
class MjcfText:
    """The text of an MJCF file, with changes to be made.

    Attributes:
        text: The text, in UTF-8.
        tags: Its start tags, in the order of the text.
    """

    text: bytes
    tags: list[Tag] = field(init=False)

    def __post_init__(self) -> None:
        """Finds the tags."""
        self.tags = _tags(self.text)
        self._changed: dict[int, dict[str, str | None]] = {}
        self._comments: dict[int, list[str]] = {}
        self._inside: dict[int, str] = {}
        self._before: dict[int, str] = {}

    def within(self, section: str) -> list[int]:
        """Returns the numbers of the tags below elements of the outermost one.

        Args:
            section: Their name, e.g. ``"worldbody"``.
        """
        return [i for i, tag in enumerate(self.tags) if tag.parents[1:2] == (section,)]

    def sections(self, name: str) -> list[int]:
        """Returns the numbers of the elements with a name directly below the outermost one."""
        return [i for i, t in enumerate(self.tags) if len(t.parents) == 1 and t.name == name]

    def child(self, number: int, name: str) -> int | None:
        """Returns the number of an element's first child with a name, ``None`` without one."""
        found = (i for i, t in enumerate(self.tags) if t.parent == number and t.name == name)
        return next(found, None)

    def set(self, number: int, attributes: Mapping[str, str | None], comment: str = "") -> None:
        """Changes attributes of an element.

        Args:
            number: Number of its tag.
            attributes: New values; ``None`` to remove the attribute.
            comment: What to write above it.
        """
        self._changed.setdefault(number, {}).update(attributes)
        known = self._comments.setdefault(number, [])
        if comment and comment not in known:
            known.append(comment)

    def insert(self, number: int, element: str) -> None:
        """Puts an element behind a start tag, as the first child of its element."""
        self._inside[number] = element

    def insert_before(self, number: int, element: str) -> None:
        """Puts an element before an element, in the same one."""
        self._before[number] = element

    def result(self) -> str:
        """Returns the text with all changes."""
        text = self.text
        places = {*self._changed, *self._comments, *self._inside, *self._before}
        for number in sorted(places, reverse=True):
            tag = self.tags[number]
            written = text[tag.start : tag.end]
            indent = _indent(text, tag.start)
            for name, value in self._changed.get(number, {}).items():
                written = _with_attribute(written, name, value)
            if number in self._inside:
                written = _opened(written, tag.name, self._inside[number], indent)
            comments = self._comments.get(number, ())
            before = b"".join(f"<!-- {text} -->".encode() + indent for text in comments)
            if number in self._before:
                before = self._before[number].encode() + indent + before
            text = text[: tag.start] + before + written + text[tag.end :]
        return text.decode()


def flattened(files: RobotFiles) -> bytes:
    """Returns the text of a robot's first file, with the content of included files in their place.

    Args:
        files: The files.

    Raises:
        ModelError: An included file cannot be read.
    """
    (first, text), *_ = files.texts.items()
    return _included(files, first, text.encode(), frozenset({first}))


def _included(files: RobotFiles, name: str, text: bytes, inside: frozenset[str]) -> bytes:
    for tag in reversed(_tags(text)):
        if tag.name != "include":
            continue
        other = tag.attributes.get("file", "")
        if other not in files.texts or other in inside:
            raise ModelError(f"{name} includes {other!r}, which cannot be read.")
        content = files.texts[other].encode()
        content = _included(files, other, content, inside | {other})
        root = _tags(content)[0]
        inner = content[root.end : content.rindex(b"</")] if b"</" in content else b""
        end = tag.end
        if not text[tag.start : tag.end].rstrip().endswith(b"/>"):
            end = text.index(b">", text.index(b"</", tag.end)) + 1
        text = text[: tag.start] + inner.strip() + text[end:]
    return text


def _tags(text: bytes) -> list[Tag]:
    """Returns all start tags of a text that is well-formed."""
    found: list[Tag] = []
    open_tags: list[int] = []
    parser = expat.ParserCreate()

    def begin(name: str, attributes: dict[str, Any]) -> None:
        start = parser.CurrentByteIndex
        parents = tuple(found[i].name for i in open_tags)
        parent = open_tags[-1] if open_tags else -1
        open_tags.append(len(found))
        found.append(Tag(name, dict(attributes), start, _end(text, start), parents, parent))

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda name: open_tags.pop() and None
    parser.Parse(text, True)
    return found


def _end(text: bytes, start: int) -> int:
    """Returns the place behind a start tag; values may contain its last character."""
    quote = None
    for place in range(start, len(text)):
        character = text[place : place + 1]
        if quote is None and character in (b'"', b"'"):
            quote = character
        elif character == quote:
            quote = None
        elif quote is None and character == b">":
            return place + 1
    return len(text)


def _indent(text: bytes, start: int) -> bytes:
    """Returns the line break and the blanks before a tag; a blank if it does not begin a line."""
    line = text[text.rfind(b"\n", 0, start) + 1 : start]
    return b"\n" + line if not line.strip() else b" "


def _with_attribute(tag: bytes, name: str, value: str | None) -> bytes:
    """Returns a start tag with an attribute set, or removed."""
    pattern = re.compile(rb"\s" + re.escape(name.encode()) + rb"\s*=\s*(\"[^\"]*\"|'[^']*')")
    new = b"" if value is None else f' {name}="{value}"'.encode()
    if pattern.search(tag):
        return pattern.sub(lambda _: new, tag, count=1)
    if value is None:
        return tag
    closing = b"/>" if tag.endswith(b"/>") else b">"
    return tag[: -len(closing)].rstrip() + new + closing


def _opened(tag: bytes, name: str, element: str, indent: bytes) -> bytes:
    """Returns a start tag followed by a first child."""
    inner = (indent + b"  " if indent != b" " else b"") + element.encode()
    if not tag.endswith(b"/>"):
        return tag + inner
    return tag[:-2].rstrip() + b">" + inner + indent.rstrip(b" ") + f"</{name}>".encode()
