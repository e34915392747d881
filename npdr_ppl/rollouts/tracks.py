"""Numbers with time stamps of their own, and what is wrong about the stamps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.sampling import MOST_BRIDGED

__all__ = ["LARGEST", "REGULAR_SHARE", "Track", "clock_notes", "usual_step"]

STEPS_TOGETHER = 5
"""Steps over which the usual step is measured: jitter of single stamps averages out, and if one
message in twenty is lost, most blocks are still complete."""

SHORT_STEP = 0.5
"""Longest step within a burst of time stamps, in usual steps. Jitter of half a step makes one step
in eight as short; in bursts of two, half of them are."""

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
                Values and time stamps from ``LARGEST`` on count as missing.
        """
        is_known = (np.abs(values) < LARGEST) & (np.abs(time) < LARGEST)
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
    """Returns the mean step of time stamps ``(N,)`` in s.

    Lost messages count as steps. Longer gaps, which need not be whole numbers of steps, are left
    out. If stamps come in bursts, which is usual where messages are sent together, the step is the
    mean over whole bursts.
    """
    time = np.unique(time)
    together = min(STEPS_TOGETHER, len(time) - 1)
    if together < 1:
        return np.inf
    usual = float(np.median(time[together:] - time[:-together])) / together
    num_bursts = int((np.diff(time) > SHORT_STEP * usual).sum())
    together = min(round((len(time) - 1) / max(num_bursts, 1)) * together, len(time) - 1)
    durations = time[together:] - time[:-together]
    count = np.rint(durations / np.median(durations) * together).clip(1)
    durations, count = durations[::together], count[::together]
    is_whole = count <= together + MOST_BRIDGED
    if is_whole.any():
        durations, count = durations[is_whole], count[is_whole]
    return float(durations.sum() / count.sum())


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
