"""Makes rollouts of signals that have been chosen, named and converted to SI units."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts.logs.log import Signal
from npdr_ppl.rollouts.recording import Recording

__all__ = ["rollouts_of"]

Array = NDArray[np.float64]


def rollouts_of(
    channels: Sequence[Signal],
    actions: Sequence[Signal],
    *,
    episodes: Signal | None = None,
    time_step: float | None = None,
) -> Recording:
    """Makes rollouts of signals, each with time stamps of its own.

    Args:
        channels: What was measured, with the names and SI units of the rollouts' channels.
        actions: What was commanded. Each value holds until the next one.
        episodes: A signal whose every change begins a new rollout; ``None`` for one rollout.
        time_step: Seconds between the steps of the rollouts; ``None`` for the median step of the
            fastest channel.

    Raises:
        DataError: Too little was recorded; the message says what.
    """
    if not channels:
        raise DataError("no signal is mapped to a channel.")
    known = [_without_gaps(signal) for signal in (*channels, *actions)]
    step = time_step or min(float(np.median(np.diff(s.time))) for s in known[: len(channels)])
    readings, commands, times = [], [], []
    for begin, end in _spans(known, episodes):
        count = int((end - begin) / step + 1e-9)
        if count < 1:
            continue
        if (len(readings) + 1) > LIMITS.rollouts or count * len(known) > LIMITS.numbers:
            raise DataError(f"{count} steps of {step:.6g} s are more than are read.")
        grid = begin + step * np.arange(count + 1)
        readings.append(
            np.stack([np.interp(grid, s.time, s.values) for s in known[: len(channels)]], axis=1)
        )
        held = [_mean_held(s, grid) for s in known[len(channels) :]]
        commands.append(np.stack(held, axis=1) if held else np.zeros((count, 0)))
        times.append(grid - begin)
    if not readings:
        raise DataError("the mapped signals have no time in common.")
    return Recording.from_arrays(
        readings,
        commands,
        channel_names=[s.name for s in channels],
        action_names=[s.name for s in actions],
        time_step=step,
        time=times,
        channel_units=[s.unit for s in channels],
        action_units=[s.unit for s in actions],
    )


def _without_gaps(signal: Signal) -> Signal:
    """Returns the values that were read, in the order of time."""
    is_known = np.isfinite(signal.values) & np.isfinite(signal.time)
    time, first = np.unique(signal.time[is_known], return_index=True)
    if len(time) < 2:
        raise DataError(f"{signal.name} has {len(time)} values, but at least two are needed.")
    return Signal(signal.name, time, signal.values[is_known][first], signal.unit)


def _spans(known: Sequence[Signal], episodes: Signal | None) -> list[tuple[float, float]]:
    """Returns begin and end of each rollout in s: where all signals are known."""
    first = max(signal.time[0] for signal in known)
    last = min(signal.time[-1] for signal in known)
    if episodes is None:
        return [(first, last)] if first < last else []
    order = np.argsort(episodes.time, kind="stable")
    time, value = episodes.time[order], episodes.values[order]
    changes = np.flatnonzero(np.diff(value) != 0) + 1
    begins = np.concatenate(([0], changes))
    ends = np.concatenate((changes - 1, [len(time) - 1]))
    spans = [(max(first, time[a]), min(last, time[b])) for a, b in zip(begins, ends, strict=True)]
    return [(a, b) for a, b in spans if a < b]


def _mean_held(signal: Signal, grid: Array) -> Array:
    """Returns the mean over each step of a value that holds until the next one, ``(T,)``."""
    lengths = np.diff(signal.time)
    area = np.concatenate(([0.0], np.cumsum(signal.values[:-1] * lengths)))
    at = np.clip(np.searchsorted(signal.time, grid, side="right") - 1, 0, None)
    integral = area[at] + signal.values[at] * (grid - signal.time[at])
    return np.diff(integral) / np.diff(grid)
