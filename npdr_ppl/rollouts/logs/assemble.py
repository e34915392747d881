"""Makes rollouts of signals that have been chosen, named and converted to SI units."""

from collections.abc import Sequence

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts.clock_jumps import stamp_notes, without_jumps
from npdr_ppl.rollouts.gridding import recording_of
from npdr_ppl.rollouts.logs.log import Signal
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.tracks import Track

__all__ = ["rollouts_of"]


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
        time_step: Seconds between the steps of the rollouts; ``None`` for the usual step of the
            fastest channel.

    Raises:
        DataError: Too little was recorded; the message says what.
    """
    if not channels:
        raise DataError("no signal is mapped to a channel.")
    signals = (*channels, *actions)
    clocks = [signal.time for signal in signals] + ([episodes.time] if episodes else [])
    times, jumps = without_jumps(clocks, len(channels))
    tracks = [Track.of(t, signal.values) for t, signal in zip(times, signals, strict=False)]
    num = len(channels)
    for k, (signal, track) in enumerate(zip(signals, tracks, strict=True)):
        fewest = 2 if k < num else 1
        if len(track) < fewest:
            raise DataError(f"{signal.name} has {len(track)} values; at least {fewest} is needed.")
    parts = [
        ([t.between(*span) for t in tracks[:num]], [t.held_between(*span) for t in tracks[num:]])
        for span in _spans(None if episodes is None else Track.of(times[-1], episodes.values))
    ]
    return recording_of(
        parts,
        [(signal.name, signal.unit) for signal in channels],
        [(signal.name, signal.unit) for signal in actions],
        time_step=time_step,
        notes=stamp_notes(times, [jumps]),
    )


def _spans(track: Track | None) -> list[tuple[float, float]]:
    """Returns begin and end of each rollout in s; each value holds until the next one.

    Raises:
        DataError: The track has no values.
    """
    if track is None:
        return [(-np.inf, np.inf)]
    if not len(track):
        raise DataError("the signal of the episodes has no values.")
    changes = np.flatnonzero(np.diff(track.values) != 0) + 1
    begins = track.time[np.concatenate(([0], changes))]
    ends = np.append(np.nextafter(track.time[changes], -np.inf), np.inf)
    return list(zip(begins.tolist(), ends.tolist(), strict=True))
