"""Decodes ROS 2 messages: definitions in the ``.msg`` language, contents in CDR.

The decoder builds plain numbers, text, lists and dictionaries. It runs no code that a log contains
or that is generated from it. Every part of a message takes at least a byte, so the work is bounded
by the size of the log.

References:
    OMG, DDS-XTypes 1.3, clause 7.4.3 (plain CDR); ROS 2, "About ROS interfaces".
"""

import re
import struct
from dataclasses import dataclass
from typing import Any

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import rollout_checks

__all__ = [
    "MAX_ARRAY",
    "MAX_NESTING",
    "Definitions",
    "Layout",
    "TooManyValuesError",
    "decode",
    "definitions",
    "layout",
    "short_name",
]

MAX_ARRAY = 100
"""Longest array of numbers whose elements become signals. Humanoids have fifty joints; longer
arrays are images, point clouds and scans."""

MAX_VALUES = 10_000
"""Largest count of values of a message, apart from arrays that are left out; a robot's state has a
hundred."""

MAX_NESTING = 16
"""Deepest nesting of message types; ROS's own reach six."""

MAX_DEFINITIONS = 500
"""Largest count of types, and of fields of a type, in the definition of a message."""

_PRIMITIVES = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip

_SIZES = {code: struct.calcsize(f"={code}") for code in _PRIMITIVES.values()}
"""Bytes of a number by its code."""

CDR_HEADER = 4
"""Bytes before the fields of a message."""

_TEXTS = ("string", "wstring")

_TIME = {"sec": "int32", "nanosec": "uint32"}

_BUILT_IN = {"builtin_interfaces/Time": _TIME, "builtin_interfaces/Duration": _TIME}

_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)\b(?!\s*=)"
)


@dataclass(frozen=True)
class Field:
    """A field of a message.

    Attributes:
        name: Its name.
        type: A primitive, ``"string"``, ``"wstring"`` or a message type ``"package/Type"``.
        count: Length of an array of fixed length, 0 for a sequence, ``None`` for a single value.
    """

    name: str
    type: str
    count: int | None


Definitions = dict[str, tuple[Field, ...]]
"""The fields of each message type, by ``package/Type``."""


def short_name(name: str) -> str:
    """Returns ``package/Type`` for ``package/msg/Type``."""
    return name.replace("/msg/", "/")


def definitions(name: str, text: str) -> Definitions:
    """Reads the definition of a message and of all types that it needs.

    Args:
        name: Name of the type, e.g. ``sensor_msgs/msg/JointState``.
        text: Its fields; further types follow behind lines of ``=`` and ``MSG: package/Type``.

    Raises:
        DataError: The text is no definition.
    """
    found: Definitions = {}
    name = short_name(name)
    for position, part in enumerate(re.split(r"^={10,}[ \t]*$", text, flags=re.MULTILINE)):
        if position > MAX_DEFINITIONS:
            raise DataError(f"a message has more than {MAX_DEFINITIONS} types.")
        if position:
            head, _, part = part.lstrip().partition("\n")
            if not head.startswith("MSG:"):
                raise DataError("a definition of a message is not in the language of ROS 2.")
            name = short_name(head.removeprefix("MSG:").strip())
        found[name] = _fields(name, part)
    for other, fields in _BUILT_IN.items():
        found.setdefault(other, tuple(Field(n, t, None) for n, t in fields.items()))
    for fields in list(found.values()):
        for field in fields:
            if field.type not in _PRIMITIVES and field.type not in _TEXTS:
                if field.type not in found:
                    raise DataError(
                        f"the definition of {rollout_checks.shown(field.type)} is missing."
                    )
    return found


def _fields(name: str, text: str) -> tuple[Field, ...]:
    """Returns the fields of a type; comments, constants and default values are left out."""
    package = name.rpartition("/")[0]
    found = []
    for line in text.splitlines():
        line = line.partition("#")[0].strip()
        if not line:
            continue
        match = _FIELD.match(line)
        if match is None:
            if re.match(r"[A-Za-z]\w*(<=\d+)?\s+[A-Za-z]\w*\s*=", line):
                continue  # a constant
            raise DataError(
                f"{rollout_checks.shown(line)} in the definition of {rollout_checks.shown(name)} "
                "is no field."
            )
        kind = short_name(match["type"])
        if kind not in _PRIMITIVES and kind not in _TEXTS:
            if kind == "Header":
                kind = "std_msgs/Header"
            elif kind in ("time", "duration"):
                kind = f"builtin_interfaces/{kind.capitalize()}"
            elif "/" not in kind:
                kind = f"{package}/{kind}"
        array = match["array"]
        count = None if array is None else int(array[1:-1]) if array[1:-1].isdecimal() else 0
        if count == 0 and array == "[0]":
            raise DataError("a message has an array of length 0.")
        found.append(Field(match["name"], kind, count))
        if len(found) > MAX_DEFINITIONS:
            raise DataError(f"a message has more than {MAX_DEFINITIONS} fields.")
    return tuple(found)


class TooManyValuesError(Exception):
    """A message has more than ``MAX_VALUES`` values, so it describes no motion of a robot."""


def decode(data: bytes, name: str, types: Definitions) -> tuple[dict[str, Any], int]:
    """Returns the fields of a message; arrays of numbers above ``MAX_ARRAY`` are ``None``.

    Args:
        data: The message in CDR, with its header of four bytes.
        name: Name of its type, ``package/Type``.
        types: The definitions of this type and of those that it needs.

    Returns:
        The fields by name, and how many values were read, which measures the work.

    Raises:
        DataError: The bytes do not hold such a message.
        TooManyValuesError: It has more than ``MAX_VALUES`` values.
    """
    reader = _Reader(data)
    try:
        message = reader.message(name, types, 0)
        return message, reader.count
    except struct.error:
        raise DataError("a message ends too early.") from None


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a message are, to read further messages that differ in them only.

    Attributes:
        places: The message with each of its numbers replaced by its place among all numbers.
        count: How many values the message has.
        size: Its length in bytes.
        same: Positions and bytes of the parts that are no numbers: lengths of arrays, and text.
        reader: Reads all numbers.
    """

    places: dict[str, Any]
    count: int
    size: int
    same: tuple[tuple[int, bytes], ...]
    reader: struct.Struct

    def numbers(self, data: bytes) -> tuple[Any, ...] | None:
        """Returns the numbers of a message, ``None`` if it differs in more than them."""
        if len(data) != self.size or not all(data.startswith(p, at) for at, p in self.same):
            return None
        return self.reader.unpack_from(data)


def layout(data: bytes, name: str, types: Definitions) -> Layout:
    """Returns the layout of a message that :func:`decode` has read; its arguments are the same."""
    reader = _Reader(data, gives_places=True)
    places = reader.message(name, types, 0)
    pattern, at = [reader.order], 0
    for start, end, code in reader.numbers:
        pattern.append(f"{start - at}x{(end - start) // _SIZES[code]}{code}")
        at = end
    same = tuple((start, data[start:end]) for start, end in [(0, CDR_HEADER), *reader.same])
    return Layout(places, reader.count, len(data), same, struct.Struct("".join(pattern)))


class _Reader:
    """Reads values one after another.

    Args:
        data: The message with its header of four bytes.
        gives_places: Whether to return the place of each number among all of them in its stead.

    Attributes:
        order: Byte order, as in :mod:`struct`.
        count: Number of values read.
        numbers: Where each number or array of numbers begins and ends, and its code.
        same: Where each length and each text begins and ends.

    Raises:
        DataError: The header is another one.
    """

    def __init__(self, data: bytes, *, gives_places: bool = False) -> None:
        if len(data) < CDR_HEADER or data[0] != 0 or data[1] not in (0, 1, 6, 7):
            raise DataError("a message is not encoded in plain CDR.")
        self._data = memoryview(data)
        self._widest = 8 if data[1] < 2 else 4
        self._position = CDR_HEADER
        self._gives_places = gives_places
        self._num_places = 0
        self.order = "<" if data[1] & 1 else ">"
        self.count = 0
        self.numbers: list[tuple[int, int, str]] = []
        self.same: list[tuple[int, int]] = []

    def message(self, name: str, types: Definitions, depth: int) -> dict[str, Any]:
        """Reads the fields of a message."""
        if depth > MAX_NESTING:
            raise DataError(f"messages are nested more than {MAX_NESTING} deep.")
        fields = types[name]
        if not fields:
            self._numbers("B", 1)  # a message without fields takes one byte
        return {field.name: self._field(field, types, depth) for field in fields}

    def _field(self, field: Field, types: Definitions, depth: int) -> Any:
        count = field.count
        if count is None:
            return self._value(field.type, types, depth)
        if count == 0:
            count = self._length()
        code = _PRIMITIVES.get(field.type)
        if code is not None:
            return self._array(code, count)
        if count > len(self._data) - self._position:
            raise DataError("a message states more elements than it has bytes.")
        elements = [self._value(field.type, types, depth) for _ in range(count)]
        return elements if count <= MAX_ARRAY else None

    def _value(self, kind: str, types: Definitions, depth: int) -> Any:
        code = _PRIMITIVES.get(kind)
        if code is not None:
            return self._numbers(code, 1)[0]
        if kind in _TEXTS:
            size = self._length() * (1 if kind == "string" else 2)
            start, self._position = self._position, self._position + size
            if self._position > len(self._data):
                raise DataError("a message ends too early.")
            self.same.append((start, self._position))
            raw = bytes(self._data[start : self._position])
            return raw.rstrip(b"\0").decode(errors="replace") if kind == "string" else ""
        return self.message(kind, types, depth + 1)

    def _array(self, code: str, count: int) -> list[float] | None:
        if count == 0:
            return []
        if count <= MAX_ARRAY:
            return list(self._numbers(code, count))
        self._align(code)
        self._position += count * _SIZES[code]
        if self._position > len(self._data):
            raise DataError("a message ends too early.")
        return None

    def _numbers(self, code: str, count: int) -> tuple[Any, ...]:
        start, numbers = self._unpacked(code, count)
        if self._gives_places:
            self.numbers.append((start, self._position, code))
            numbers = tuple(range(self._num_places, self._num_places + count))
            self._num_places += count
        return numbers

    def _length(self) -> int:
        start, (length,) = self._unpacked("I", 1)
        self.same.append((start, self._position))
        return length

    def _unpacked(self, code: str, count: int) -> tuple[int, tuple[Any, ...]]:
        """Returns where the next numbers begin, and the numbers."""
        self.count += count
        if self.count > MAX_VALUES:
            raise TooManyValuesError
        self._align(code)
        start = self._position
        numbers = struct.unpack_from(f"{self.order}{count}{code}", self._data, start)
        self._position += count * _SIZES[code]
        return start, numbers

    def _align(self, code: str) -> None:
        size = min(_SIZES[code], self._widest)
        self._position += -(self._position - CDR_HEADER) % size
