"""Numbers with time stamps of their own, and what is wrong about the stamps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.sampling import MOST_BRIDGED

__all__ = ["Track", "clock_notes", "stamp_notes", "usual_step", "without_restarts"]

STEPS_TOGETHER = 5
"""Steps over which the usual step is measured: jitter of single stamps averages out, and if one
message in twenty is lost, most blocks are still complete."""

REGULAR_SHARE = 0.5
"""Share of the steps of a stream that have to be usual if it is written at a rate."""

MOST_JITTER = 0.4
"""Largest departure of a usual step, as a share of it. Stamps with 5 ms of jitter at 50 Hz have
steps that depart by up to a half, but most of them by less than a third."""

MULTIPLE_ERROR = 0.1
"""Largest departure from a multiple of the shortest step, as a share of it, in a stream that was
written at two rates."""

CLOCK_DIFFERENCES = 2e-5, 1e-2
"""Relative differences between two rates that are taken for those of two clocks: quartz errs by
1e-5 to 1e-4. Larger ones are other rates."""

UNKNOWN_LATENESS = 0.25
"""Standard deviation of a lateness, in steps, above which a drift is not estimated. A lateness
that is spread evenly over a step has 0.29; its whole steps cannot be counted."""

FEWEST_STEPS = 10
"""Fewest steps of a stream that can be called regular."""

LARGEST = 1e100
"""Magnitude from which a number is taken for damaged bytes: nothing is measured in so small a
unit, and products of two such numbers would overflow."""

RESOLUTION = 1e-9
"""Smallest difference in s between two time stamps; logs count in nanoseconds at the finest."""


@dataclass(frozen=True)
class Track:
    """One number over time.

    Attributes:
        time: Increasing time stamps in s, ``(N,)``.
        values: Values, ``(N,)``.
    """

    time: Array
    values: Array

    @classmethod
    def of(cls, time: Array, values: Array) -> "Track":
        """Returns the values that are known, in the order of time.

        Of stamps that differ by less than ``RESOLUTION``, only the first is taken.

        Args:
            time: Time stamps in s, ``(N,)``.
            values: Values, NaN where one is missing, ``(N,)``.
                Values from ``LARGEST`` on count as missing.
        """
        is_known = (np.abs(values) < LARGEST) & np.isfinite(time)
        time, first = np.unique(time[is_known], return_index=True)
        is_new = np.diff(time, prepend=-np.inf) >= RESOLUTION
        return cls(time[is_new], values[is_known][first][is_new])

    def __len__(self) -> int:
        return len(self.time)

    def between(self, begin: float, end: float) -> "Track":
        """Returns the values of a stretch of time."""
        chosen = (self.time >= begin) & (self.time <= end)
        return Track(self.time[chosen], self.values[chosen])

    def held_between(self, begin: float, end: float) -> "Track":
        """Returns values that hold until the next one, with the one that holds at the begin."""
        part = self.between(begin, end)
        before = int(np.searchsorted(self.time, begin)) - 1
        if before < 0 or (len(part) and part.time[0] == begin):
            return part
        return Track(
            np.concatenate(([begin], part.time)),
            np.concatenate((self.values[before : before + 1], part.values)),
        )

    @property
    def step(self) -> float:
        """Usual time between two values in s."""
        return usual_step(self.time)

    @property
    def rate(self) -> float | None:
        """Seconds between the values of a regular stream; ``None`` if they were written on change.

        A stream is regular if at least half of its steps are usual, or are multiples of its
        shortest one.
        """
        steps = np.diff(self.time)
        if len(steps) < FEWEST_STEPS:
            return None
        usual = float(np.median(steps))
        if np.mean(np.abs(steps - usual) < MOST_JITTER * usual) >= REGULAR_SHARE:
            return usual
        shortest = float(np.min(steps))
        departure = np.abs(steps - np.rint(steps / shortest) * shortest)
        is_multiple = np.mean(departure < MULTIPLE_ERROR * shortest) >= REGULAR_SHARE
        return shortest if is_multiple else None

    @property
    def last_known(self) -> float:
        """Time in s until which a value that holds until the next one is known."""
        if self.rate is None:
            return np.inf
        return float(self.time[-1]) + float(np.diff(self.time).max())


def usual_step(time: Array) -> float:
    """Returns the mean step of time stamps ``(N,)`` in s; a gap counts as several steps."""
    time = np.unique(time)
    together = min(STEPS_TOGETHER, len(time) - 1)
    if together < 1:
        return np.inf
    durations = time[together:] - time[:-together]
    count = np.rint(durations / np.median(durations) * together).clip(1)
    return float(durations[::together].sum() / count[::together].sum())


def without_restarts(times: Sequence[Array]) -> tuple[tuple[Array, ...], int]:
    """Returns time stamps of clocks that were restarted together as those of one clock.

    A stamp that lies more than ``MOST_BRIDGED`` usual steps before the last one shows a restart.
    How long it took is not known, so what follows is placed behind a gap.

    Args:
        times: Time stamps of each signal in the order in which they were written, in s.

    Returns:
        The time stamps, and the number of restarts.
    """
    parts = [_between_restarts(time) for time in times]
    num = max(len(part) for part in parts)
    if num == 1:
        return tuple(times), 0
    forward = [np.diff(time)[np.diff(time) > 0] for time in times]
    gap = (MOST_BRIDGED + 2.0) * max(float(np.median(s)) for s in forward if len(s))
    moved: list[list[Array]] = [[] for _ in times]
    end = -np.inf
    for k in range(num):
        present = [part[k] for part in parts if k < len(part) and len(part[k])]
        shift = 0.0 if k == 0 else end + gap - min(float(time.min()) for time in present)
        for own, part in zip(moved, parts, strict=True):
            if k < len(part):
                own.append(part[k] + shift)
        end = shift + max(float(time.max()) for time in present)
    return tuple(np.concatenate(own) for own in moved), num - 1


def stamp_notes(times: Sequence[Array], num_restarts: int) -> list[str]:
    """Returns what is wrong about time stamps, and what is done about it, a sentence each.

    Args:
        times: Time stamps of each signal in the order in which they were written, without
            restarts, in s.
        num_restarts: How often the clock was restarted.
    """
    notes = []
    if num_restarts:
        often = "once" if num_restarts == 1 else f"{num_restarts} times"
        notes.append(f"The clock was restarted {often}; the data after it are another stretch.")
    steps = [np.diff(time[np.isfinite(time)]) for time in times]
    repeated = max((int((step == 0).sum()) for step in steps), default=0)
    swapped = max((int((step < 0).sum()) for step in steps), default=0)
    if repeated:
        notes.append(f"Repeated time stamps: {repeated}; the first sample of each is used.")
    if swapped:
        notes.append(f"Samples out of order: {swapped}; sorted by their time stamps.")
    return notes


def clock_notes(rollouts: Sequence[tuple[Sequence[Track], Sequence[Track]]]) -> list[str]:
    """Returns a sentence if commands and measurements were stamped by clocks that differ.

    Args:
        rollouts: Channels and actions of each rollout.
    """
    pairs = [(own[0], commands[0]) for own, commands in rollouts if own and commands]
    drifts = [found for pair in pairs if (found := _drift(*pair)) is not None]
    if not drifts:
        return []
    drift, error = np.median(np.abs(drifts), axis=0).tolist()
    least, most = CLOCK_DIFFERENCES
    if not max(least, 5.0 * error) < drift < most:
        return []
    return [
        f"The clocks of commands and measurements differ by {100 * drift:.2g} %, which looks "
        f"like a delay that changes by {6e4 * drift:.2g} ms per minute."
    ]


def _between_restarts(time: Array) -> list[Array]:
    """Splits time stamps where the clock went back."""
    steps = np.diff(time)
    if not (steps < 0).any() or not (steps > 0).any():
        return [time]
    usual = float(np.median(steps[steps > 0]))
    back = np.flatnonzero(steps[:-1] < -MOST_BRIDGED * usual)
    # After a single late message the clock is where it was before.
    return np.split(time, back[time[back + 2] <= time[back]] + 1)


def _drift(channel: Track, commands: Track) -> tuple[float, float] | None:
    """Returns how fast commands get late relative to measurements, in s/s, and its error.

    Only commands that differ from the ones before are compared, as a table repeats a command at
    each measurement that it was not written with. ``None`` if they do not change at the rate of
    the measurements, or if jitter spreads their lateness over a step: it is known but for whole
    steps.
    """
    changed = commands.time[np.diff(commands.values, prepend=np.nan) != 0.0]
    if min(len(changed), len(channel)) <= STEPS_TOGETHER:
        return None
    step = channel.step
    if abs(usual_step(changed) / step - 1.0) > CLOCK_DIFFERENCES[1]:
        return None
    after = np.searchsorted(channel.time, changed).clip(1, len(channel) - 1)
    before = channel.time[after - 1]
    nearest = np.where(changed - before < channel.time[after] - changed, after - 1, after)
    lateness = np.unwrap(changed - channel.time[nearest], period=step)
    passed, late = changed - changed.mean(), lateness - lateness.mean()
    # Of stamps that hardly differ or are near the largest number, the squares are 0 or infinite.
    with np.errstate(over="ignore", invalid="ignore"):
        square = float(passed @ passed)
        if not 0.0 < square < np.inf:
            return None
        slope = float(passed @ late) / square
        rest = late - slope * passed
        if rest.std() > UNKNOWN_LATENESS * step:
            return None
        return slope, float(rest @ rest / (len(rest) - 2) / square) ** 0.5
