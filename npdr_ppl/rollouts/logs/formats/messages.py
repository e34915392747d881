"""Collects the numbers of messages as signals, one signal for each number of a topic."""

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.formats.ros_messages import MAX_ARRAY, MAX_NESTING, Layout
from npdr_ppl.rollouts.logs.formats.time_stamps import MAX_CLOCK_DIFFERENCE, in_seconds
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.notes import Remark

__all__ = ["Messages"]

FREE_NUMBERS = 1_000_000
"""Count of numbers that the messages of any log may have."""

NUMBERS_PER_BYTE = 4
"""Numbers per byte that a larger log may have. A number takes eight bytes before compression,
which gains a factor of twenty for a robot that stands still."""

_Numbers = list[tuple[str, float | None]]
"""Numbers with their names; ``None`` for an array left out."""

_NAMES = ("name", "names", "joint_names")
"""Fields that name the elements of the other arrays, as in ``sensor_msgs/JointState``."""

_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
"""Units of ``sensor_msgs/JointState`` for revolute joints, by its definition."""


@dataclass
class _Series:
    """One number over time."""

    at: array = field(default_factory=lambda: array("q"))
    values: array = field(default_factory=lambda: array("d"))


@dataclass
class _Topic:
    """The messages of a topic.

    Attributes:
        received: Time stamps of the recorder in ns.
        stamped: Time stamps of the messages in ns, 0 where a message has none.
        series: Values by name, each with the positions of their messages.
        units: Unit by name of the field.
        has_long: Whether an array was too long.
        layout: The layout of the latest messages, if they have one.
        places: Each series with the place of its numbers in a message of this layout.
        stamp_places: The same for the parts of the messages' own stamp in s and ns.
    """

    received: array = field(default_factory=lambda: array("q"))
    stamped: array = field(default_factory=lambda: array("q"))
    series: dict[str, _Series] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    has_long: bool = False
    layout: Layout | None = None
    places: list[tuple[_Series, int]] = field(default_factory=list)
    stamp_places: tuple[int, int] | None = None


class Messages:
    """The messages of a log, topic by topic.

    Args:
        file_bytes: Size of the log in bytes, which bounds how many numbers it may have.
    """

    def __init__(self, file_bytes: int) -> None:
        self._topics: dict[str, _Topic] = {}
        self._notes: dict[str, None] = {}
        self._numbers = 0
        self._signals = 0
        self._allowed = min(LIMITS.numbers, max(FREE_NUMBERS, NUMBERS_PER_BYTE * file_bytes))

    def fault(self, sentence: str) -> None:
        """Keeps a sentence about what is wrong with the log, once."""
        self._notes[sentence] = None

    def remark(self, sentence: str) -> None:
        """Keeps a sentence about what was left out, once."""
        if len(self._notes) < 100:
            self._notes[Remark(sentence)] = None

    def add(self, topic: str, kind: str, nanoseconds: int, message: Any) -> None:
        """Adds a message.

        Args:
            topic: Its topic.
            kind: Name of its type.
            nanoseconds: Time stamp of the recorder in ns.
            message: Its fields: numbers, text, lists and dictionaries.

        Raises:
            DataError: The log has more numbers or signals than may be read.
        """
        entry = self._topics.get(topic)
        if entry is None:
            if len(self._topics) >= LIMITS.columns:
                raise DataError(f"it has more than {LIMITS.columns} topics.")
            is_joints = kind.replace("/msg/", "/") == "sensor_msgs/JointState"
            entry = self._topics[topic] = _Topic(units=_UNITS if is_joints else {})
        row = self._add_times(entry, nanoseconds, _stamp(_stamp_parts(message)))
        numbers: _Numbers = []
        _numbers(message, _element_names(message), 0, "", numbers)
        for name, value in numbers:
            if value is None:
                entry.has_long = True
                continue
            series = entry.series.get(name)
            if series is None:
                self._signals += 1
                if self._signals > LIMITS.columns:
                    raise DataError(f"it has more than {LIMITS.columns} signals.")
                series = entry.series[name] = _Series()
            series.at.append(row)
            series.values.append(value)

    def add_alike(self, topic: str, nanoseconds: int, layout: Layout, read: Sequence[Any]) -> None:
        """Adds a message with the same layout as one that was added before.

        Args:
            topic: Its topic.
            nanoseconds: Time stamp of the recorder in ns.
            layout: The layout.
            read: The numbers of the message.
        """
        entry = self._topics[topic]
        if entry.layout is not layout:
            numbers: _Numbers = []
            _numbers(layout.places, _element_names(layout.places), 0, "", numbers)
            entry.places = [(entry.series[n], int(p)) for n, p in numbers if p is not None]
            entry.stamp_places = _stamp_parts(layout.places)
            entry.layout = layout
        stamp = entry.stamp_places
        parts = None if stamp is None else (read[stamp[0]], read[stamp[1]])
        row = self._add_times(entry, nanoseconds, _stamp(parts))
        for series, place in entry.places:
            series.at.append(row)
            series.values.append(read[place])

    def _add_times(self, entry: _Topic, nanoseconds: int, stamped: int) -> int:
        """Adds the time stamps of a message; returns its position in the topic."""
        if not -(2**63) <= nanoseconds < 2**63:
            raise DataError("a time stamp is out of range.")
        entry.received.append(nanoseconds)
        entry.stamped.append(stamped)
        return len(entry.received) - 1

    def charge(self, count: int) -> None:
        """Counts numbers that were read.

        Raises:
            DataError: There are more than the size of the log allows.
        """
        self._numbers += count
        if self._numbers > self._allowed:
            raise DataError(
                f"its messages have more than the {self._allowed} numbers that are read from a "
                "log of this size."
            )

    def log(self, source: str, *, use_stamps: bool) -> Log:
        """Returns the signals.

        Args:
            source: Name of the log.
            use_stamps: Whether the time of a message is its own stamp, where it has one.
        """
        signals = []
        for topic, entry in self._topics.items():
            if entry.has_long:
                self.remark(
                    f"{rollout_checks.shown(topic)}: arrays of more than {MAX_ARRAY} numbers were "
                    "left out."
                )
            time = self._time(topic, entry, use_stamps)
            for name, series in entry.series.items():
                values = np.array(series.values, dtype=np.float64)
                values[np.isinf(values)] = np.nan
                at = np.array(series.at, dtype=np.int64)
                unit = entry.units.get(name.rpartition("/")[2], "")
                signals.append(Signal(f"{topic}/{name}", time[at], values, unit))
        if not signals:
            raise DataError(
                "it has no messages of numbers that can be read."
                if not self._notes
                else f"it has no messages of numbers that can be read: {next(iter(self._notes))}"
            )
        return Log(source, tuple(signals), tuple(self._notes))

    def _time(self, topic: str, entry: _Topic, use_stamps: bool) -> np.ndarray:
        received = in_seconds(np.array(entry.received, dtype=np.int64), 10**9)
        stamps = np.array(entry.stamped, dtype=np.int64)
        if not use_stamps or not stamps.all():
            return received
        stamped = in_seconds(stamps, 10**9)
        difference = float(np.median(received - stamped))
        if abs(difference) > MAX_CLOCK_DIFFERENCE:
            self.remark(
                f"{rollout_checks.shown(topic)}: the stamps differ from the recorder's clock by "
                f"{difference:.3g} s, so its time is the recorder's."
            )
            return received
        return stamped


def _stamp_parts(message: Any) -> tuple[Any, Any] | None:
    """Returns the seconds and the nanoseconds of the stamp that a message carries, if it does."""
    if not isinstance(message, dict):
        return None
    header = message.get("header")
    inner = header if isinstance(header, dict) else message
    stamp = inner.get("stamp", inner.get("timestamp"))
    if not isinstance(stamp, dict):
        return None
    return stamp.get("sec"), stamp.get("nanosec", stamp.get("nsec"))


def _stamp(parts: tuple[Any, Any] | None) -> int:
    """Returns a time stamp in ns, 0 if there is none."""
    if parts is None:
        return 0
    seconds, rest = parts
    if type(seconds) is not int or type(rest) is not int or not -(2**31) <= seconds < 2**33:
        return 0
    return seconds * 10**9 + rest if 0 <= rest < 10**9 else 0


def _element_names(message: Any) -> list[str] | None:
    """Returns the names that a message gives to the elements of its arrays."""
    if not isinstance(message, dict):
        return None
    for key in _NAMES:
        names = message.get(key)
        if names and isinstance(names, list) and all(isinstance(n, str) and n for n in names):
            is_plain = all(len(n) <= 100 and n.isprintable() for n in names)
            return names if is_plain and len(set(names)) == len(names) else None
    return None


def _numbers(value: Any, names: list[str] | None, depth: int, path: str, found: _Numbers) -> None:
    """Adds the numbers of a message with their names; ``None`` for an array left out."""
    if depth > MAX_NESTING:
        raise DataError(f"messages are nested more than {MAX_NESTING} deep.")
    if isinstance(value, float):
        found.append((path or "value", value))
    elif isinstance(value, int):
        try:
            found.append((path or "value", float(value)))
        except OverflowError:
            found.append((path or "value", float("nan")))
    elif isinstance(value, dict):
        for key, inner in value.items():
            if key == "header" or (key in ("stamp", "timestamp") and isinstance(inner, dict)):
                continue
            word = str(key)[:100]
            _numbers(inner, names, depth + 1, f"{path}/{word}" if path else word, found)
    elif isinstance(value, list):
        if len(value) > MAX_ARRAY:
            found.append((path, None))
            return
        is_named = names is not None and len(names) == len(value)
        for index, inner in enumerate(value):
            if names is not None and is_named and isinstance(inner, int | float):
                _numbers(inner, None, depth, f"{names[index]}/{path}", found)
            else:
                _numbers(inner, names, depth + 1, f"{path}.{index}", found)
    elif value is None and path:
        found.append((path, None))
