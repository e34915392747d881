"""Time stamps whose clock jumped: single wrong stamps, restarts, and pauses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.sampling import MOST_BRIDGED
from npdr_ppl.rollouts.tracks import LARGEST, REGULAR_SHARE, usual_step

__all__ = ["Jumps", "restarts", "stamp_notes", "without_jumps"]

LONGEST_PAUSE = 10_000
"""Longest pause, in usual steps of the fastest channel, that stays as long as it is. A longer one
would cost memory for nothing: with 20 columns, 10 000 empty steps take 4 MB, and a clock that is
set from 0 to the time since 1970 jumps by 10¹¹ steps."""


@dataclass(frozen=True)
class Jumps:
    """What was done about the jumps of a clock.

    Attributes:
        num_outlying: Number of time stamps that are not used.
        num_restarts: How often the clock was restarted.
        pauses: Duration of each pause that was shortened, in s.
    """

    num_outlying: int = 0
    num_restarts: int = 0
    pauses: tuple[float, ...] = ()


def without_jumps(times: Sequence[Array], num_channels: int) -> tuple[tuple[Array, ...], Jumps]:
    """Returns time stamps of clocks that jumped together as those of one clock.

    * A single stamp that lies apart from the others becomes NaN.
    * A stamp that lies more than ``MOST_BRIDGED`` usual steps before the last one shows a restart.
      How long it took is not known, so what follows is placed behind a gap.
    * A pause of all channels, or a clock that was set forward, becomes a gap if it takes more than
      ``LONGEST_PAUSE`` steps.

    Args:
        times: Time stamps of each signal in the order in which they were written, in s.
        num_channels: Number of signals at the beginning of ``times`` that are channels.

    Returns:
        The time stamps, and what was done.
    """
    times, num_outlying = _without_outliers(times)
    times, num_restarts = _without_restarts(times, num_channels)
    times, pauses = _without_pauses(times, num_channels)
    return tuple(times), Jumps(num_outlying, num_restarts, pauses)


def stamp_notes(times: Sequence[Array], jumps: Sequence[Jumps]) -> list[str]:
    """Returns what is wrong about time stamps, and what is done about it, a sentence each.

    Args:
        times: Time stamps of each signal in the order in which they were written, without jumps,
            in s.
        jumps: What was done about the jumps of the clocks.
    """
    notes = []
    outlying = sum(jump.num_outlying for jump in jumps)
    restarts = sum(jump.num_restarts for jump in jumps)
    pauses = [pause for jump in jumps for pause in jump.pauses]
    if outlying:
        notes.append(
            f"Wrong time stamps, far from the others or ahead of the next one: {outlying}; these "
            "samples are not used."
        )
    if restarts:
        often = "once" if restarts == 1 else f"{restarts} times"
        notes.append(f"The clock was restarted {often}; the data after it are another stretch.")
    if pauses:
        notes.append(
            f"Pauses or forward jumps of the clock: {len(pauses)}, the longest of "
            f"{max(pauses):.6g} s; they are shortened, and the data after each are another "
            "stretch."
        )
    steps = [np.diff(time[np.isfinite(time)]) for time in times]
    repeated = max((int((step == 0).sum()) for step in steps), default=0)
    swapped = max((int((step < 0).sum()) for step in steps), default=0)
    if repeated:
        notes.append(f"Repeated time stamps: {repeated}; the first sample of each is used.")
    if swapped:
        notes.append(f"Samples out of order: {swapped}; sorted by their time stamps.")
    return notes


def _usual(time: Array) -> float:
    """Returns the median forward step in s of stamps in the order of writing; NaN without one."""
    steps = np.diff(time[np.isfinite(time)])
    forward = steps[steps > 0]
    return float(np.median(forward)) if len(forward) else np.nan


def _mean(time: Array) -> float:
    """Returns the mean step in s, also of bursts, in the longest part without a restart."""
    part = max(_between_restarts(time), key=len)
    step = usual_step(part[np.isfinite(part)])
    return step if np.isfinite(step) else np.nan


def _gap(channels: Sequence[Array]) -> float:
    """Returns the length of a gap in s that no channel bridges."""
    usual = [step for step in map(_mean, channels) if step == step]
    longest = LONGEST_PAUSE * min(usual, default=0.0)
    return min((MOST_BRIDGED + 2.0) * max(usual, default=0.0), longest)


# -- Single wrong stamps -----------------------------------------------------------------------


def _without_outliers(times: Sequence[Array]) -> tuple[list[Array], int]:
    """Returns time stamps with NaN for single ones that are wrong, and the number of these."""
    wrong = [_is_ahead(time) | (np.abs(time) >= LARGEST) for time in times]
    times = [np.where(bad, np.nan, time) for time, bad in zip(times, wrong, strict=True)]
    near = [_is_near(time) for time in times]
    regular = [
        bool(len(time)) and bool(np.mean(close) >= REGULAR_SHARE)
        for time, close in zip(times, near, strict=True)
    ]
    stamps = [t[c] for t, c, r in zip(times, near, regular, strict=True) if r]
    if stamps:
        first = min(float(part.min()) for part in stamps)
        last = max(float(part.max()) for part in stamps)
        # A stamp that is nearer costs at most as many empty steps as the recording has.
        reach = last - first
        for k, time in enumerate(times):
            is_outside = (time < first - reach) | (time > last + reach)
            # Commands that are written on change may come long before or after everything else.
            is_single = ~near[k] & (regular[k] | _is_out_of_order(time))
            wrong[k] = wrong[k] | (is_outside & is_single)
        times = [np.where(bad, np.nan, time) for time, bad in zip(times, wrong, strict=True)]
    return times, max((int(bad.sum()) for bad in wrong), default=0)


def _is_ahead(time: Array) -> NDArray[np.bool_]:
    """Returns which stamps lie ahead of the next one, while that one follows the one before."""
    result = np.zeros(len(time), dtype=bool)
    middle = time[1:-1]
    result[1:-1] = (middle > time[2:] + MOST_BRIDGED * _usual(time)) & (time[2:] > time[:-2])
    return result


def _is_near(time: Array) -> NDArray[np.bool_]:
    """Returns which stamps lie at most ``MOST_BRIDGED`` usual steps from one beside them."""
    is_short = np.abs(np.diff(time)) <= MOST_BRIDGED * _usual(time)
    result = np.zeros(len(time), dtype=bool)
    result[1:] |= is_short
    result[:-1] |= is_short
    return result


def _is_out_of_order(time: Array) -> NDArray[np.bool_]:
    """Returns which stamps lie before the one written before, or after the one written next."""
    is_back = np.diff(time) < 0
    result = np.zeros(len(time), dtype=bool)
    result[1:] |= is_back
    result[:-1] |= is_back
    return result


# -- Restarts ----------------------------------------------------------------------------------


def _without_restarts(times: Sequence[Array], num_channels: int) -> tuple[Sequence[Array], int]:
    """Returns time stamps that go on behind a gap after each restart, and the number of these."""
    parts = [_between_restarts(time) for time in times]
    num = max(len(part) for part in parts)
    if num == 1:
        return times, 0
    gap = _gap(times[:num_channels])
    moved: list[list[Array]] = [[] for _ in times]
    end = -np.inf
    for k in range(num):
        known = [part[k][np.isfinite(part[k])] for part in parts if k < len(part)]
        present = [time for time in known if len(time)]
        shift = 0.0
        if k and present:
            shift = end + gap - min(float(time.min()) for time in present)
        for own, part in zip(moved, parts, strict=True):
            if k < len(part):
                own.append(part[k] + shift)
        end = max((end, *(shift + float(time.max()) for time in present)))
    return [np.concatenate(own) for own in moved], num - 1


def _between_restarts(time: Array) -> list[Array]:
    """Splits time stamps where the clock went back."""
    begins = restarts(time)
    return np.split(time, begins) if len(begins) else [time]


def restarts(time: Array) -> NDArray[np.intp]:
    """Returns the indices of the first time stamps after the clock went back.

    It went back if a stamp lies more than ``MOST_BRIDGED`` usual steps before the last one, unless
    the next stamp goes on from the last one: then a single message was late.
    """
    known = np.flatnonzero(np.isfinite(time))
    stamps = time[known]
    steps = np.diff(stamps)
    if not (steps < 0).any() or not (steps > 0).any():
        return np.empty(0, dtype=np.intp)
    back = np.flatnonzero(steps[:-1] < -MOST_BRIDGED * _usual(time))
    return known[back[stamps[back + 2] <= stamps[back]] + 1]


# -- Pauses ------------------------------------------------------------------------------------


def _without_pauses(
    times: Sequence[Array], num_channels: int
) -> tuple[Sequence[Array], tuple[float, ...]]:
    """Returns time stamps with long pauses of all channels shortened, and how long they were."""
    channels = [time[np.isfinite(time)] for time in times[:num_channels]]
    usual = min((s for s in map(_mean, channels) if s == s), default=np.inf)
    every = np.unique(np.concatenate(channels)) if channels else np.empty(0)
    durations = np.diff(every)
    long = np.flatnonzero(durations > LONGEST_PAUSE * usual)
    if not len(long):
        return times, ()
    begins, ends, gap = every[long], every[long + 1], _gap(channels)
    shift = np.concatenate(([0.0], np.cumsum(durations[long] - gap)))
    shortened = []
    for time in times:
        k = np.searchsorted(ends, time, side="right")
        begin, end = (edge[k.clip(0, len(long) - 1)] for edge in (begins, ends))
        is_within = (k < len(long)) & (time > begin)
        # Commands within a pause stay in their order.
        within = begin + gap * (time - begin) / (end - begin)
        shortened.append(np.where(is_within, within, time) - shift[k])
    return shortened, tuple(durations[long].tolist())
