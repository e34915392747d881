"""How a log is read: the table ``[log]`` of a mapping."""

import re
from typing import Literal

import msgspec

__all__ = ["HOW_TO_NAME_TIME", "TIME_UNITS", "LogSettings", "TimeUnit", "time_unit_of"]

TimeUnit = Literal["s", "ms", "us", "ns"]

TIME_UNITS: dict[TimeUnit, int] = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Ticks in a second, by unit of time stamps."""

_WORDS = re.compile("(m|u|n|milli|micro|nano)?s(?:ecs?|econds?)?")
"""Units of time stamps in words."""


def time_unit_of(unit: str) -> TimeUnit | None:
    """Returns the unit of time stamps that a text means, e.g. ``"msec"``; ``None`` if none."""
    found = _WORDS.fullmatch(re.sub(r"[µμ]", "u", unit.strip().lower()))
    if found is None:
        return None
    prefix = found[1] or ""
    prefix = {"milli": "m", "micro": "u", "nano": "n"}.get(prefix, prefix)
    return next(known for known in TIME_UNITS if known == f"{prefix}s")


HOW_TO_NAME_TIME = (
    "name one with `npdr inspect LOG --time NAME --write mapping.toml`, or give --time-step in "
    "seconds; a mapping has them as time and time_step in [log]."
)
"""End of the message about a log whose time stamps are not recognised: what to do."""


class LogSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a log is read; whatever is ``None`` is guessed from the log.

    Attributes:
        time: Name of the column or data set with the time stamps; ``"log"`` in a ROS bag takes
            the recorder's time stamps where messages have stamps of their own.
        time_unit: Unit of the time stamps.
        header: Whether the first line of a CSV file names the columns.
        episodes: Signal whose every change begins a new rollout; ``""`` for one rollout.
        time_step: Seconds between the steps of the rollouts. In a table without time stamps, also
            the seconds between rows.
    """

    time: str | None = None
    time_unit: TimeUnit | None = None
    header: bool | None = None
    episodes: str | None = None
    time_step: float | None = None
