"""Puts measurements and commands with time stamps of their own on a uniform grid."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import rollout_checks
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.sampling import (
    MOST_BRIDGED,
    Sampling,
    Spans,
    common,
    placed,
    spans_without_gaps,
    split,
)
from npdr_ppl.rollouts.tracks import Track, clock_notes

__all__ = ["Gridded", "at_one_rate", "grid_of", "on_given_grids", "recording_of", "tracks_of"]

FEWEST_SMOOTHED = 5
"""Fewest measurements that are interpolated by cubic polynomials; Akima's method needs as many."""

JITTER = 0.1
"""Lateness, in steps, above which it is reported; less is compensated, too."""

PHASE_SHARE = 0.1
"""Weight of the newest stamp in the running mean of a clock's phase, about the mean of 20 stamps:
it follows a clock that drifts, and has a quarter of the jitter of one stamp."""

JUMP = 5.0
"""Change of a command across lost ones, in median changes nearby, above which it may be a jump: a
straight line does not tell when it happened."""

JUMP_SHARE = 0.2
"""Smallest share of the command's range that is a jump. A smooth command that is written with
coarse steps, or held for several rows, changes less from one value to the next."""

NEARBY = 10
"""Number of commands before, and after, a gap that tell how much the command usually changes."""

MOST_LOST = 0.9
"""Share of the steps with a measurement below which a channel is reported as a slower one."""


@dataclass(frozen=True)
class Gridded:
    """One rollout on a grid of T steps; see :class:`~npdr_ppl.rollouts.recording.Recording`.

    Attributes:
        time: Times of the rows in s, from zero, ``(T + 1,)``.
        readings: Interpolated measurements, ``(T + 1, C)``.
        actions: Mean commands of the steps, ``(T, A)``.
        sampling: The measurements as they were taken.
        num_unused: Number of measurements of each channel that share a row with another one and
            are not used, ``(C,)``.
        is_unknown: Whether a command was lost when it jumped, ``(T,)``.
    """

    time: Array
    readings: Array
    actions: Array
    sampling: Sampling
    num_unused: NDArray[np.int64]
    is_unknown: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        channels: Sequence[Track],
        time: Array,
        actions: Array,
        step: float,
        is_unknown: NDArray[np.bool_] | None = None,
    ) -> "Gridded":
        """Puts measurements on a grid that is known.

        The readings follow from the measurements on the grid alone. A file that keeps these gives
        the same rollout again.

        Args:
            channels: What was measured.
            time: Times of the rows in s on the clock of the channels, ``(T + 1,)``.
            actions: Mean commands of the steps, ``(T, A)``.
            step: Seconds between the rows.
            is_unknown: As the attribute; ``None`` if no command was lost.
        """
        shape = (len(time), len(channels))
        readings, lateness = np.zeros(shape), np.zeros(shape)
        is_read, num_unused = np.zeros(shape, dtype=bool), np.zeros(len(channels), dtype=np.int64)
        values = np.zeros(shape)
        for k, track in enumerate(channels):
            found = placed((track.time - time[0]) / step, track.values, len(time))
            rows = np.flatnonzero(found.is_read)
            at = rows + found.lateness[rows]
            readings[:, k] = _interpolated(at, found.values[rows], len(time))
            exact = rows[found.lateness[rows] == 0.0]
            readings[exact, k] = found.values[exact]
            values[:, k] = np.where(found.is_read, found.values, readings[:, k])
            lateness[:, k], is_read[:, k] = found.lateness, found.is_read
            num_unused[k] = found.num_unused
        if is_unknown is None:
            is_unknown = np.zeros(len(actions), dtype=bool)
        sampling = Sampling(values, lateness, is_read)
        return cls(time, readings, actions, sampling, num_unused, is_unknown)

    @cached_property
    def spans(self) -> Spans:
        """The stretches without long gaps, in which all commands are known."""
        return split(self.spans_measured, np.flatnonzero(self.is_unknown).tolist())

    @cached_property
    def spans_measured(self) -> Spans:
        """The stretches without long gaps between measurements."""
        return spans_without_gaps(self.sampling.is_read)


def grid_of(channels: Sequence[Track], actions: Sequence[Track], step: float) -> Gridded | None:
    """Returns a rollout on a grid that begins where everything is known for the first time.

    Args:
        channels: What was measured.
        actions: What was commanded; each value holds until the next one.
        step: Seconds between the rows.

    Returns:
        ``None`` if all is known for less than one step.

    Raises:
        DataError: The grid would have more numbers than may be read.
    """
    tracks = (*channels, *actions)
    if any(len(track) < 1 for track in tracks) or any(len(track) < 2 for track in channels):
        return None
    begin = max(float(track.time[0]) for track in tracks)
    end = min(float(track.time[-1]) for track in channels)
    end = min((end, *(track.last_known for track in actions)))
    # The last measurement may come a little before its row.
    count = int((end - begin) / step + 0.5)
    if count < 1:
        return None
    if count * len(tracks) > LIMITS.numbers:
        raise DataError(f"{count} steps of {step:.6g} s are more than are read.")
    rows = step * np.arange(count + 1, dtype=np.float64)
    is_unknown = np.zeros(count, dtype=bool)
    commands = []
    for track in actions:
        bridged, jumps = _bridged(track)
        commands.append(_mean_held(bridged, begin + rows))
        for first, last in (jumps - begin) / step:
            is_unknown[max(0, math.floor(first + 1e-6)) : max(0, math.ceil(last - 1e-6))] = True
    return Gridded.of(
        [Track(track.time - begin, track.values) for track in channels],
        rows,
        np.stack(commands, axis=1) if commands else np.zeros((count, 0)),
        step,
        is_unknown,
    )


def _interpolated(at: Array, values: Array, num_rows: int) -> Array:
    """Returns values at each row; beyond the ends, those of the ends.

    Args:
        at: Increasing times of the values, in steps after the first row, ``(N,)``.
        values: The values, ``(N,)``; zero is returned if there are none.
        num_rows: Number of rows.
    """
    if not len(at):
        return np.zeros(num_rows)
    inside = np.clip(np.arange(num_rows, dtype=np.float64), at[0], at[-1])
    if len(at) < FEWEST_SMOOTHED:
        return np.interp(inside, at, values)
    return np.asarray(Akima1DInterpolator(at, values)(inside), dtype=np.float64)


def _bridged(track: Track) -> tuple[Track, Array]:
    """Fills the short gaps in a regular stream of commands by straight lines.

    Commands that were written only when they changed are left as they are.

    Returns:
        The commands, and the times in s between which one that jumped is not known, ``(N, 2)``.
    """
    usual, steps = track.rate, np.diff(track.time)
    if usual is None or not (steps > 1.5 * usual).any():
        return track, np.zeros((0, 2))
    mean = track.step
    # The median step differs from the mean one if a clock of whole milliseconds rounds.
    count = np.diff(_slots(track.time, mean if abs(mean - usual) < 0.5 * usual else usual))
    lost = np.flatnonzero(count > 1)
    jumps = [
        (track.time[k] + steps[k] / count[k], track.time[k + 1])
        for k in lost
        if _jumps(track.values, int(k))
    ]
    unknown = np.reshape(np.array(jumps, dtype=np.float64), (-1, 2))
    short = lost[count[lost] <= MOST_BRIDGED]
    if not len(short):
        return track, unknown
    time = [track.time[k] + steps[k] * np.arange(1, int(count[k])) / count[k] for k in short]
    added = np.concatenate(time)
    every = np.concatenate((track.time, added))
    order = np.argsort(every, kind="stable")
    values = np.concatenate((track.values, np.interp(added, track.time, track.values)))
    return Track(every[order], values[order]), unknown


def _jumps(values: Array, index: int) -> bool:
    """Returns whether a command and the next one differ by much more than those around them."""
    changes = np.abs(np.diff(values[max(0, index - NEARBY) : index + 2 + NEARBY]))
    change = changes[min(index, NEARBY)]
    return bool(change > max(JUMP * np.median(changes), JUMP_SHARE * np.ptp(values)))


def _slots(time: Array, usual: float) -> NDArray[np.int64]:
    """Returns which tick of a clock each time stamp belongs to, ``(N,)``, increasing.

    With jitter, a stamp that is late follows a long step and precedes a short one; no tick is lost
    there. The clock's phase is a running mean, so that it may drift.

    Args:
        time: Increasing time stamps in s.
        usual: Seconds between two ticks.
    """
    slots, phase = [0], float(time[0])
    for number, stamp in enumerate(time[1:].tolist(), start=2):
        slots.append(max(slots[-1] + 1, round((stamp - phase) / usual)))
        late = stamp - phase - slots[-1] * usual
        # A long gap need not be a whole number of steps.
        is_long = slots[-1] - slots[-2] > MOST_BRIDGED
        phase += late * (1.0 if is_long else max(1.0 / number, PHASE_SHARE))
    return np.array(slots)


def _mean_held(track: Track, grid: Array) -> NDArray[np.float64]:
    """Returns the mean over each step of values that hold until the next one, ``(T,)``."""
    area = np.concatenate(([0.0], np.cumsum(track.values[:-1] * np.diff(track.time))))
    at = np.clip(np.searchsorted(track.time, grid, side="right") - 1, 0, None)
    integral = area[at] + track.values[at] * (grid - track.time[at])
    held = np.diff(integral) / np.diff(grid)
    # Where one value holds for a whole step, it is kept to the last bit.
    last = at[1:] - (track.time[at[1:]] >= grid[1:])
    return np.where(last == at[:-1], track.values[at[:-1]], held)


def recording_of(
    rollouts: Sequence[tuple[Sequence[Track], Sequence[Track]]],
    channels: Sequence[tuple[str, str]],
    actions: Sequence[tuple[str, str]],
    *,
    time_step: float | None = None,
    notes: Sequence[str] = (),
) -> Recording:
    """Returns the recording of rollouts with time stamps of their own.

    Args:
        rollouts: Channels and actions of each rollout. Rollouts that are shorter than a step are
            left out.
        channels: Name and unit of each channel.
        actions: Name and unit of each action.
        time_step: Seconds between the steps; ``None`` for the usual step of the fastest channel.
        notes: What was left out or changed before, a sentence each.

    Raises:
        DataError: Nothing is left.
    """
    by_channel = [
        [own[k].step for own, _ in rollouts if len(own[k]) > 1] for k in range(len(channels))
    ]
    # The median over rollouts, so that an odd one does not decide.
    steps = [float(np.median(own)) for own in by_channel if own]
    if not steps:
        raise DataError("less than two measurements were recorded.")
    if len(rollouts) > LIMITS.rollouts:
        raise DataError(f"it has {len(rollouts)} rollouts, more than {LIMITS.rollouts}.")
    step = float(f"{min(steps):.9g}") if time_step is None else time_step
    rollout_checks.check_time_step(step)
    notes = (*notes, *clock_notes(rollouts))
    return _recording_at(rollouts, channels, actions, step, notes)


def _recording_at(
    rollouts: Sequence[tuple[Sequence[Track], Sequence[Track]]],
    channels: Sequence[tuple[str, str]],
    actions: Sequence[tuple[str, str]],
    step: float,
    notes: Sequence[str],
) -> Recording:
    """Returns the recording of rollouts with a time step; arguments as for recording_of."""
    made = [grid_of(*tracks, step) for tracks in rollouts]
    parts = [part for part in made if part is not None]
    if not parts:
        raise DataError("the channels and actions have no time in common.")
    if len(made) > len(parts):
        notes = (
            *notes,
            f"Rollouts shorter than a step: {len(made) - len(parts)}; left out.",
        )
    return on_given_grids(parts, channels, actions, time_step=step, notes=notes)


def on_given_grids(
    parts: Sequence[Gridded],
    channels: Sequence[tuple[str, str]],
    actions: Sequence[tuple[str, str]],
    *,
    time_step: float,
    notes: Sequence[str] = (),
) -> Recording:
    """Returns the recording of rollouts that are on grids with the same time step.

    Args:
        parts: The rollouts, at least one.
        channels: Name and unit of each channel.
        actions: Name and unit of each action.
        time_step: Seconds between the rows.
        notes: What was left out or changed before, a sentence each.
    """
    samplings = tuple(part.sampling for part in parts)
    return Recording(
        readings=tuple(part.readings for part in parts),
        actions=tuple(part.actions for part in parts),
        channel_names=tuple(name for name, _ in channels),
        action_names=tuple(name for name, _ in actions),
        time_step=time_step,
        time=tuple(part.time for part in parts),
        channel_units=tuple(unit for _, unit in channels),
        action_units=tuple(unit for _, unit in actions),
        samplings=() if all(part.is_regular for part in samplings) else samplings,
        stretches=tuple(part.spans for part in parts),
        notes=(*notes, *_notes(parts, [name for name, _ in channels])),
    )


def at_one_rate(recordings: Sequence[Recording]) -> list[Recording]:
    """Returns recordings with the time step of the fastest one.

    Args:
        recordings: Recordings with the same columns.
    """
    step = min(recording.time_step for recording in recordings)
    if all(math.isclose(r.time_step, step, rel_tol=1e-6) for r in recordings):
        return list(recordings)
    return [_at_step(recording, step) for recording in recordings]


def _at_step(recording: Recording, step: float) -> Recording:
    """Returns a recording with another, smaller time step."""
    notes = recording.notes
    if recording.rewards is not None:
        notes = (*notes, Remark("Rates differ; rewards are left out."))
    # The commands are on the grid, whose clock is not theirs: clocks were compared before.
    made = _recording_at(
        [tracks_of(recording, index) for index in range(len(recording))],
        list(zip(recording.channel_names, recording.channel_units, strict=True)),
        list(zip(recording.action_names, recording.action_units, strict=True)),
        step,
        notes,
    )
    if recording.is_whole or len(made) < len(recording):
        return made
    ratio = recording.time_step / step
    stretches = []
    for index, (spans, found) in enumerate(zip(recording.spans, made.spans, strict=True)):
        if spans == spans_without_gaps(recording.sampling(index).is_read):
            stretches.append(found)  # nothing but gaps, which were found again
            continue
        usable = [(math.ceil(first * ratio), math.floor(end * ratio)) for first, end in spans]
        stretches.append(common(found, tuple(usable)))
    return replace(made, stretches=tuple(stretches))


def tracks_of(recording: Recording, index: int) -> tuple[list[Track], list[Track]]:
    """Returns the measurements and the commands of one rollout with their times."""
    time, readings = recording.time[index], recording.readings[index]
    channels = []
    for k in range(readings.shape[1]):
        if recording.samplings:
            sampling = recording.samplings[index]
            taken = sampling.is_read[:, k]
            late = recording.time_step * sampling.lateness[taken, k]
            channels.append(Track.of(time[taken] + late, sampling.values[taken, k]))
        else:
            channels.append(Track.of(time, readings[:, k]))
    return channels, [Track.of(time[:-1], values) for values in recording.actions[index].T]


def _notes(parts: Sequence[Gridded], channels: Sequence[str]) -> list[str]:
    """Returns what was found about the times of the measurements, a sentence each."""
    notes = []
    late = np.concatenate([np.abs(part.sampling.lateness).max(1) for part in parts])
    if (late > JITTER).any():
        notes.append(
            Remark(
                "Time stamps are uneven: simulations are compared with measurements at the times "
                "at which they were taken."
            )
        )
    used = np.sum([part.sampling.is_read.sum(0) for part in parts], axis=0).tolist()
    num_unused = np.sum([part.num_unused for part in parts], axis=0).tolist()
    shared: dict[str, list[str]] = {}
    for name, taken, unused in zip(channels, used, num_unused, strict=True):
        if unused:
            shared.setdefault(f"{unused} of {unused + taken} measurements", []).append(name)
    if shared:
        num_channels = max(2, len(channels))
        told = "; ".join(
            f"{number} of {', '.join(names) if len(names) < num_channels else 'every channel'}"
            for number, names in shared.items()
        )
        notes.append(Remark(f"{told} share a time step with another and are not used."))
    num_rows = sum(len(part.time) for part in parts)
    slow = [
        f"{name} ({taken / num_rows:.0%})"
        for name, taken, unused in zip(channels, used, num_unused, strict=True)
        if taken + unused < MOST_LOST * num_rows
    ]
    if slow:
        notes.append(Remark(f"Not measured at every step: {', '.join(slow)}."))
    total = sum(len(part.actions) for part in parts)
    measured = sum(end - first for part in parts for first, end in part.spans_measured)
    kept = sum(end - first for part in parts for first, end in part.spans)
    if measured < total:
        notes.append(
            f"Gaps: {total - measured} of {total} steps have no measurements nearby and are left "
            "out."
        )
    if kept < measured:
        notes.append(
            f"Lost commands: {measured - kept} of {total} steps in which a command jumped are "
            "left out."
        )
    return notes
