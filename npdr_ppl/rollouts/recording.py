"""Recorded or simulated episodes as arrays of matching shapes; file readers return these."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import rollout_checks, states
from npdr_ppl.rollouts.arrays import Array, as_arrays, frozen
from npdr_ppl.rollouts.motion_time import motion_time
from npdr_ppl.rollouts.sampling import Sampling, Spans
from npdr_ppl.rollouts.states import StateEstimate

__all__ = ["Recording"]


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """R recorded or simulated episodes with the same columns and the same time step.

    Episodes may differ in length: T below is the number of steps of one of them. The measurements
    need not contain the whole state, e.g. a position without its velocity.

    Attributes:
        readings: Measurements before each step and after the last one, one ``(T + 1, C)`` per
            rollout, in ``channel_units``.
        actions: Commands, each held for one step, one ``(T, A)`` per rollout, in ``action_units``.
        channel_names: Names of the C channels.
        action_names: Names of the A actions.
        time_step: Seconds between measurements.
        rewards: Rewards of the steps, one ``(T,)`` per rollout, or ``None``.
        time: Time stamps in s, one ``(T + 1,)`` per rollout; ``k·time_step`` if not given.
        channel_units: Units of the channels, ``""`` where unknown.
        action_units: Units of the actions, ``""`` where unknown.
        samplings: Of each rollout, its measurements as they were taken, if they were not all taken
            at the times of the rows; ``readings`` are then interpolated.
        stretches: First step and end of the usable stretches of each rollout; empty if all of
            every rollout is usable. Between them, measurements or commands are missing or wrong.
        notes: What was left out or changed in the recording, a sentence each.

    Raises:
        DataError: A column name is invalid, shapes do not match, values are not finite, the
            sampling is not constant, or no stretch is usable.
    """

    readings: tuple[Array, ...]
    actions: tuple[Array, ...]
    channel_names: tuple[str, ...]
    action_names: tuple[str, ...]
    time_step: float
    rewards: tuple[Array, ...] | None = None
    time: tuple[Array, ...] = ()
    channel_units: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    samplings: tuple[Sampling, ...] = ()
    stretches: tuple[Spans, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Copies the arrays, makes them read-only and checks them."""
        freeze = object.__setattr__
        for field in ("channel_names", "action_names", "channel_units", "action_units"):
            freeze(self, field, tuple(getattr(self, field)))
        _check_columns(self)
        freeze(self, "time_step", float(self.time_step))
        if not self.time:
            lengths = (len(values) for values in self.readings)
            freeze(self, "time", tuple(self.time_step * np.arange(n) for n in lengths))
        for field in ("readings", "actions", "time", "rewards"):
            values = getattr(self, field)
            freeze(self, field, values and tuple(frozen(v) for v in values))
        freeze(self, "channel_units", self.channel_units or ("",) * len(self.channel_names))
        freeze(self, "action_units", self.action_units or ("",) * len(self.action_names))
        _check_arrays(self)
        _check_stretches(self)
        if self.stretches == _whole(self.lengths):
            freeze(self, "stretches", ())

    @classmethod
    def from_arrays(
        cls,
        readings: ArrayLike | Tensor | Sequence[Any],
        actions: ArrayLike | Tensor | Sequence[Any] | None = None,
        *,
        channel_names: Sequence[str],
        action_names: Sequence[str] = (),
        time_step: float | None = None,
        rewards: ArrayLike | Tensor | Sequence[Any] | None = None,
        time: ArrayLike | Tensor | Sequence[Any] | None = None,
        channel_units: Sequence[str] = (),
        action_units: Sequence[str] = (),
    ) -> Self:
        """Makes a recording from arrays or tensors.

        Args:
            readings: ``(R, T + 1, C)``, or a list of ``(T + 1, C)`` of different lengths.
            actions: ``(R, T, A)`` or a list of ``(T, A)``; ``None`` if there are no commands.
            channel_names: Names of the C channels.
            action_names: Names of the A actions.
            time_step: Seconds between measurements; may be left out if ``time`` is given.
            rewards: ``(R, T)`` or a list of ``(T,)``.
            time: Time stamps in s, ``(R, T + 1)`` or a list of ``(T + 1,)``.
            channel_units: Units of the channels.
            action_units: Units of the actions.

        Raises:
            DataError: The arrays do not match each other or are not valid data.
        """
        values = as_arrays(readings, "readings")
        times = () if time is None else as_arrays(time, "time")
        if time_step is None:
            if not times or min(len(t) for t in times) < 2:
                raise DataError("give a time step or time stamps of at least two readings.")
            time_step = rollout_checks.canonical_time_step(times)
        if actions is None:
            commands = tuple(np.zeros((max(len(v) - 1, 0), 0)) for v in values)
        else:
            commands = as_arrays(actions, "actions")
        return cls(
            readings=values,
            actions=commands,
            channel_names=tuple(channel_names),
            action_names=tuple(action_names),
            time_step=time_step,
            rewards=None if rewards is None else as_arrays(rewards, "rewards"),
            time=times,
            channel_units=tuple(channel_units),
            action_units=tuple(action_units),
        )

    @property
    def lengths(self) -> tuple[int, ...]:
        """Number of steps T of each rollout."""
        return tuple(len(actions) for actions in self.actions)

    def __len__(self) -> int:
        return len(self.readings)

    @cached_property
    def estimates(self) -> dict[tuple[tuple[int, int, int], ...], StateEstimate]:
        """Cache that maps a tuple of segments to their estimated initial states.

        Smoothing costs as much as hundreds of simulations, and the initial states are the same for
        every model of a recording.
        """
        return {}

    @cached_property
    def rate_changes(self) -> Array:
        """Root-mean-square change of each channel's rate during a time step, ``(C,)``."""
        return states.rate_changes(self.usable_readings, self.time_step)

    @cached_property
    def motion_time(self) -> float:
        """Time in s after which the motion is no straight line; see :func:`motion_time`."""
        return motion_time(self.usable_readings, self.time_step)

    @property
    def measured_names(self) -> tuple[str, ...]:
        """Names of the channels of which at least one measurement was taken."""
        if not self.samplings:
            return self.channel_names
        is_read = np.any([sampling.is_read.any(axis=0) for sampling in self.samplings], axis=0)
        return tuple(n for n, read in zip(self.channel_names, is_read, strict=True) if read)

    @property
    def spans(self) -> tuple[Spans, ...]:
        """First step and end of every usable stretch of each rollout."""
        return self.stretches or _whole(self.lengths)

    @property
    def usable_readings(self) -> tuple[Array, ...]:
        """The readings of every usable stretch of every rollout, ``(T + 1, C)`` each."""
        return tuple(
            readings[first : end + 1]
            for readings, spans in zip(self.readings, self.spans, strict=True)
            for first, end in spans
        )

    @property
    def usable_actions(self) -> tuple[Array, ...]:
        """The actions of every usable stretch of every rollout, ``(T, A)`` each."""
        return tuple(
            actions[first:end]
            for actions, spans in zip(self.actions, self.spans, strict=True)
            for first, end in spans
        )

    def sampling(self, index: int) -> Sampling:
        """Returns the measurements of one rollout as they were taken."""
        return self.samplings[index] if self.samplings else Sampling.at_rows(self.readings[index])

    def measurements(self, column: int) -> tuple[Array, ...]:
        """Returns one channel's measurements of every usable stretch, ``(N,)`` each."""
        if not self.samplings:
            return tuple(readings[:, column] for readings in self.usable_readings)
        return tuple(
            sampling.values[first : end + 1, column][sampling.is_read[first : end + 1, column]]
            for sampling, spans in zip(self.samplings, self.spans, strict=True)
            for first, end in spans
        )

    @property
    def num_usable(self) -> int:
        """Number of steps of all usable stretches."""
        return sum(end - first for spans in self.spans for first, end in spans)

    @property
    def is_whole(self) -> bool:
        """Whether all of every rollout is usable."""
        return not self.stretches


def _whole(lengths: Sequence[int]) -> tuple[Spans, ...]:
    """Returns the stretches of rollouts that are usable as a whole."""
    return tuple(((0, length),) for length in lengths)


def _check_stretches(recording: "Recording") -> None:
    """Raises a DataError if samplings or usable stretches do not fit the rollouts."""
    shapes = [readings.shape for readings in recording.readings]
    if recording.samplings and [s.values.shape for s in recording.samplings] != shapes:
        raise DataError("samplings and readings have different shapes.")
    if not recording.stretches:
        return  # all of every rollout is usable
    if len(recording.spans) != len(recording.readings):
        raise DataError(
            f"there are {len(recording.readings)} rollouts, but usable stretches of "
            f"{len(recording.spans)}."
        )
    for index, (spans, length) in enumerate(zip(recording.spans, recording.lengths, strict=True)):
        edges = [edge for span in spans for edge in span]
        if edges and not (
            all(first < end for first, end in spans)
            and edges == sorted(edges)
            and edges[0] >= 0
            and edges[-1] <= length
        ):
            raise DataError(f"the usable stretches of rollout {index} are {spans}.")
    if not any(recording.spans):
        raise DataError(
            "no stretch of the recording is usable"
            + (f": {recording.notes[-1]}" if recording.notes else ".")
        )


def _check_columns(recording: "Recording") -> None:
    """Raises a DataError if names, units or the time step are wrong."""
    names = (*recording.channel_names, *recording.action_names)
    rollout_checks.check_names(names)
    taken = set(rollout_checks.RESERVED_NAMES) & set(names)
    if taken:
        raise DataError(f"{min(taken)} is a reserved name, not a channel's or an action's.")
    if not recording.channel_names:
        raise DataError("the data have no channels, only actions.")
    if not recording.readings:
        raise DataError("the data have no rollouts.")
    if not (math.isfinite(recording.time_step) and recording.time_step > 0):
        raise DataError(f"the time step is {recording.time_step} s, but it must be positive.")
    for field, units, columns in (
        ("channel_units", recording.channel_units, recording.channel_names),
        ("action_units", recording.action_units, recording.action_names),
    ):
        if len(units) not in (0, len(columns)):
            raise DataError(f"{field} has {len(units)} entries for {len(columns)} columns.")
        rollout_checks.check_unit_texts(units, columns)


def _check_arrays(recording: "Recording") -> None:
    """Raises a DataError if shapes differ, values are not finite or sampling is not constant."""
    per_rollout: dict[str, Sequence[Array] | None] = {
        "actions": recording.actions,
        "time": recording.time,
        "rewards": recording.rewards,
    }
    for name, arrays in per_rollout.items():
        if arrays is not None and len(arrays) != len(recording.readings):
            raise DataError(
                f"there are {len(recording.readings)} rollouts of readings, but {len(arrays)} of "
                f"{name}."
            )
    for index, readings in enumerate(recording.readings):
        where = f"rollout {index}"
        steps = len(readings) - 1
        if steps < 1:
            raise DataError(
                f"{where} has {steps + 1} row, but at least two are needed for one step."
            )
        actions, time = recording.actions[index], recording.time[index]
        wanted = {
            "readings": (readings, (steps + 1, len(recording.channel_names))),
            "actions": (actions, (steps, len(recording.action_names))),
            "time": (time, (steps + 1,)),
        }
        if recording.rewards is not None:
            wanted["rewards"] = (recording.rewards[index], (steps,))
        for name, (values, shape) in wanted.items():
            if values.shape != shape:
                raise DataError(
                    f"{name} of {where} should have shape {shape}, got {values.shape}."
                )
    rollout_checks.check_values(recording.readings, recording.channel_names)
    rollout_checks.check_values(recording.actions, recording.action_names)
    rollout_checks.check_values([time[:, None] for time in recording.time], ("time",))
    if recording.rewards is not None:
        rollout_checks.check_values([r[:, None] for r in recording.rewards], ("reward",))
    rollout_checks.check_times(recording.time)
    found = rollout_checks.canonical_time_step(recording.time)
    if abs(found - recording.time_step) > rollout_checks.MAX_RATE_DIFFERENCE * recording.time_step:
        raise DataError(
            f"time stamps are {found:.6g} s apart, but the time step is said to be "
            f"{recording.time_step:.6g} s."
        )
