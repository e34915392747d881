"""Describes a log: which signals it has, when they were recorded, and what they look like."""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.rollouts.clock_jumps import without_jumps
from npdr_ppl.rollouts.logs.log import Log, Signal
from npdr_ppl.rollouts.logs.signal_names import Role, role_of
from npdr_ppl.rollouts.logs.unit_remarks import rates_without_unit
from npdr_ppl.rollouts.logs.units import is_known
from npdr_ppl.rollouts.tracks import LARGEST, usual_step

__all__ = ["Description", "SignalSummary", "Timing", "described"]

Array = NDArray[np.float64]

GAP = 2.0
"""Smallest step that counts as a gap, in usual steps: at least one sample is missing."""

LONGEST_UNIT = 40
"""Number of characters at the end of a signal's name in which its unit is looked for."""

USUAL_SHARE = 95
"""Share of the steps, in percent, that the jitter describes."""

_UNITS_IN_NAMES = {
    **{"deg": "deg", "degrees": "deg", "rad": "rad", "rpm": "rpm", "dps": "deg/s"},
    **{"mm": "mm", "cm": "cm", "volt": "V", "volts": "V", "mv": "mV", "ma": "mA", "amp": "A"},
    **{"nm": "N m", "percent": "percent"},
}
"""Units by the last word of a signal's name, in lower case."""


@dataclass(frozen=True)
class SignalSummary:
    """What is known of a signal.

    Attributes:
        name: Its name in the log.
        unit: The unit that the log or its name states, ``""`` if none.
        least: Smallest value in ``unit``, NaN if there is no value.
        greatest: Largest value in ``unit``, NaN if there is no value.
        role: What its name usually means, or its unit.
        place: Its place among the signals of the log, from 0.
    """

    name: str
    unit: str
    least: float
    greatest: float
    role: Role
    place: int = 0

    @property
    def is_constant(self) -> bool:
        """Whether it never changes, or has no values."""
        return not self.least < self.greatest


@dataclass(frozen=True)
class Timing:
    """The signals that share their time stamps, and these time stamps.

    Attributes:
        signals: The signals.
        count: Number of time stamps.
        begin: First time stamp in s after the log's begin.
        end: Last time stamp in s after the log's begin.
        step: Usual step between time stamps in s, as in the rollouts; NaN if there is none.
        jitter: ``USUAL_SHARE`` percent of the steps are within this of the usual step, in s.
        largest: Largest step in s.
        largest_at: Begin of the largest step in s after the log's begin.
        gaps: Number of steps of at least ``GAP`` usual steps.
        backwards: Number of time stamps that repeat the one before or go back.
    """

    signals: tuple[SignalSummary, ...]
    count: int
    begin: float
    end: float
    step: float
    jitter: float
    largest: float
    largest_at: float
    gaps: int
    backwards: int


@dataclass(frozen=True)
class Description:
    """What a log contains.

    Attributes:
        source: Name of the log.
        timings: Groups of signals with the same time stamps.
        duration: Time from the first to the last time stamp in s.
        notes: What the reader guessed or left out, and which units should be checked.
        episodes: Name of the signal whose every change begins an episode, or ``""``.
    """

    source: str
    timings: tuple[Timing, ...]
    duration: float
    notes: tuple[str, ...]
    episodes: str


def described(log: Log) -> Description:
    """Describes a log."""
    groups: dict[bytes, list[tuple[int, Signal]]] = {}
    for place, signal in enumerate(log.signals):
        groups.setdefault(_known_time(signal).tobytes(), []).append((place, signal))
    times = [_known_time(group[0][1]) for group in groups.values()]
    first = min((float(t.min()) for t in times if len(t)), default=0.0)
    last = max((float(t.max()) for t in times if len(t)), default=0.0)
    timings = [
        _timing(time - first, group) for time, group in zip(times, groups.values(), strict=True)
    ]
    signals = [signal for timing in timings for signal in timing.signals]
    rates = rates_without_unit([(s.name, s.name, s.unit) for s in signals])
    notes = (*log.notes, *rates)
    return Description(log.source, tuple(timings), last - first, notes, log.episodes)


def _known_time(signal: Signal) -> Array:
    return signal.time[np.isfinite(signal.values) & (np.abs(signal.time) < LARGEST)]


def _timing(time: Array, signals: list[tuple[int, Signal]]) -> Timing:
    """Describes the signals that share time stamps ``(N,)``, in s after the log's begin."""
    steps = np.diff(time)
    forward = steps[steps > 0]
    step = jitter = largest = at = float("nan")
    (stamps,), _ = without_jumps((time,), 1)
    usual = usual_step(stamps[np.isfinite(stamps)])
    if len(forward) and np.isfinite(usual):
        step = usual
        jitter = float(np.percentile(np.abs(forward - step), USUAL_SHARE))
        largest, at = float(steps.max()), float(time[np.argmax(steps)])
    return Timing(
        signals=tuple(_summary(signal, place) for place, signal in signals),
        count=len(time),
        begin=float(time[0]) if len(time) else 0.0,
        end=float(time[-1]) if len(time) else 0.0,
        step=step,
        jitter=jitter,
        largest=largest,
        largest_at=at,
        gaps=int((steps > GAP * step * (1 - 0.1)).sum()),
        backwards=int((steps <= 0).sum()),
    )


def _summary(signal: Signal, place: int) -> SignalSummary:
    known = signal.values[np.isfinite(signal.values)]
    unit = signal.unit or _unit_in(signal.name)
    return SignalSummary(
        name=signal.name,
        unit=unit,
        least=float(known.min()) if len(known) else float("nan"),
        greatest=float(known.max()) if len(known) else float("nan"),
        role=role_of(signal.name, unit),
        place=place,
    )


def _unit_in(name: str) -> str:
    """Returns the unit that a name states, e.g. ``deg`` of ``angle_deg`` or ``angle [deg]``."""
    end = name[-LONGEST_UNIT:].rstrip()
    in_brackets = re.fullmatch(r".*[\[(]([^\[\]()]+)[\])]", end)
    if in_brackets and is_known(in_brackets[1]):
        return in_brackets[1].strip()
    words = re.findall(r"[a-z]+", end.lower())
    return _UNITS_IN_NAMES.get(words[-1], "") if words else ""
