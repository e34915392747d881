"""Finds the time stamps of a log by their name, and their unit by name and size."""

import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.logs.log_settings import TIME_UNITS, LogSettings, TimeUnit

__all__ = [
    "MAX_CLOCK_DIFFERENCE",
    "guessed_unit",
    "in_seconds",
    "is_stamp",
    "is_time_name",
    "seconds_of",
    "time_name",
]

Array = NDArray[np.float64]

_NAMES = (
    *("time", "timestamp", "timestamps", "__time", "%time", "t", "tout", "stamp", "header/stamp"),
    *("log_time", "elapsed", "elapsed_time", "sample_time", "datetime", "ts"),
)
"""Names of time stamps, the most usual ones first; in lower case, without a unit."""

_UNIT_WORDS: dict[str, TimeUnit] = {
    **{"s": "s", "sec": "s", "secs": "s", "seconds": "s"},
    **{"ms": "ms", "msec": "ms", "milliseconds": "ms"},
    **{"us": "us", "µs": "us", "usec": "us", "microseconds": "us"},
    **{"ns": "ns", "nsec": "ns", "nanoseconds": "ns"},
}

MAX_CLOCK_DIFFERENCE = 1.0
"""Largest median difference, in s, between the stamps of messages and the recorder's clock. Above
it the two clocks differ, and signals with and without stamps would not fit together."""

_EPOCH: tuple[tuple[float, TimeUnit], ...] = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Smallest time stamps since 1970 in these units: 1973 or later."""

_STEPS: tuple[tuple[float, TimeUnit], ...] = ((5e5, "ns"), (500.0, "us"), (0.5, "ms"))
"""Smallest steps of time stamps in these units. Robots are sampled at 2 Hz to 2 kHz."""

SLOWEST_STEP = 1.1
"""Longest step that may be one in seconds although it may be one in milliseconds, too: of a slow
log at 1 Hz, with a tolerance of a tenth. A robot that is sampled at 1 kHz has the same numbers."""

LEAST_DURATION = 1.0
"""Shortest recording in s. Where steps may be seconds or milliseconds, time stamps that would end
sooner are taken for seconds: t = 0, 1, 2, … 300 is a log of five minutes, not of 0.3 s."""


def _split(name: str) -> tuple[str, TimeUnit | None]:
    """Returns a name in lower case without its unit, and the unit if it has one."""
    word = name.strip().lower()
    found = re.fullmatch(r"(.*?)\s*[\[(]\s*(\S+?)\s*[\])]", word) or re.fullmatch(
        r"(.*)_([^\W_]+)", word
    )
    if found and found[2] in _UNIT_WORDS:
        return found[1], _UNIT_WORDS[found[2]]
    return word, None


def is_stamp(name: str) -> bool:
    """Returns whether a column holds the stamps of a message, as in ``/imu/header/stamp``."""
    return name.replace(".", "/").lower().endswith("header/stamp")


def is_time_name(name: str) -> bool:
    """Returns whether a column of this name, of any group, usually holds time stamps."""
    return _split(re.split(r"[/.]", name)[-1])[0] in _NAMES or is_stamp(name)


def time_name(names: Iterable[str]) -> str | None:
    """Returns the name that most likely belongs to the time stamps of all columns."""
    # ``Ts`` usually is a sampling period.
    found = [(name, _split(name)[0]) for name in names if name.strip() != "Ts"]
    for wanted in _NAMES:
        for name, word in found:
            if word == wanted:
                return name
    stamps = [name for name, _ in found if is_stamp(name)]
    return stamps[0] if len(stamps) == 1 else None


def guessed_unit(name: str, stamps: Array) -> TimeUnit:
    """Returns the unit that the name states, or that fits the size of the time stamps.

    Args:
        name: Name of the time stamps, e.g. ``time_ms``.
        stamps: Time stamps, ``(N,)``, NaN where one is missing.
    """
    stated = _split(re.split(r"[/.]", name)[-1])[1]
    if stated is not None:
        return stated
    known = stamps[np.isfinite(stamps)]
    if not len(known):
        return "s"
    size = float(np.max(np.abs(known)))
    for least, unit in _EPOCH:
        if size >= least:
            return unit
    steps = np.diff(known)
    steps = steps[steps > 0]
    usual = float(np.median(steps)) if len(steps) else 0.0
    duration = float(known.max() - known.min()) / TIME_UNITS["ms"]
    if usual <= SLOWEST_STEP and duration < LEAST_DURATION:
        return "s"
    for least, unit in _STEPS:
        if usual >= least:
            return unit
    return "s"


def seconds_of(name: str, stamps: Array, settings: LogSettings) -> tuple[Array, str]:
    """Converts time stamps to s.

    Args:
        name: Name of the time stamps.
        stamps: Time stamps, ``(N,)``, NaN where one is missing.
        settings: How the log is read.

    Returns:
        Time stamps in s, ``(N,)``, and a sentence about what was guessed, or ``""``.
    """
    unit = settings.time_unit or guessed_unit(name, stamps)
    note = (
        ""
        if settings.time and settings.time_unit
        else (f"time is {rollout_checks.shown(name)}, taken as {unit}")
    )
    return stamps / TIME_UNITS[unit], note


def in_seconds(ticks: NDArray[np.int64], per_second: int) -> Array:
    """Converts integer time stamps to s, exact to the last digit of a float64.

    Args:
        ticks: Time stamps, ``(N,)``.
        per_second: Ticks in a second.
    """
    if not np.issubdtype(ticks.dtype, np.integer):
        raise DataError("time stamps should be integers.")
    return ticks // per_second + (ticks % per_second) / per_second
