"""Segments: pieces of rollouts, each simulated from an initial state taken from the data."""

import warnings
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.errors import DataError, ShapeError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.rollouts.recording import Recording
from npdr_ppl.rollouts.sampling import NEAREST
from npdr_ppl.rollouts.states import StateEstimate, estimate_states

__all__ = [
    "InitialState",
    "columns_of",
    "cut",
    "default_history",
    "inputs",
    "layout_of",
    "motion",
    "motion_by_channel",
    "observation",
    "stitch",
]

InitialState = Literal["estimated", "recorded", "uncertain"]
"""How the state at a segment's start is found. ``estimated``: the measurements are smoothed and
differentiated. ``recorded``: the measurements are taken as exact. ``uncertain``: every simulation
draws its initial state from the estimate and its error."""

_HISTORY_SECONDS = 5.0
_LEAST_HISTORY = 64
_MOST_PAST_VALUES = 1 << 22


def default_history(time_step: float, num_segments: int, num_actions: int) -> int:
    """Returns the default number of past commands per segment.

    They last for five seconds, in which a servo's profile generator reaches its goals, or shorter
    if they would take more than 32 MiB. There are at least 64, which is longer than any input
    delay of a working control loop.

    Args:
        time_step: Seconds per step.
        num_segments: Number of segments.
        num_actions: Number of commands.
    """
    most = _MOST_PAST_VALUES // max(1, num_segments * num_actions)
    return max(_LEAST_HISTORY, min(round(_HISTORY_SECONDS / time_step), most))


def columns_of(wanted: Sequence[str], names: Sequence[str]) -> list[int]:
    """Returns the positions of ``wanted`` in ``names``.

    Raises:
        DataError: Some are missing; the message names them.
    """
    missing = [name for name in wanted if name not in names]
    if missing:
        raise DataError(
            f"{', '.join(missing)} was not recorded; the channels are {', '.join(names)}."
        )
    return [list(names).index(name) for name in wanted]


def inputs(
    rollouts: Recording,
    *,
    segment_length: int | None,
    initial_state: InitialState,
    history: int | None,
    dtype: torch.dtype,
) -> Inputs:
    """Cuts rollouts into segments; see :meth:`Rollouts.inputs`."""
    if initial_state not in get_args(InitialState):
        known = ", ".join(repr(name) for name in get_args(InitialState))
        raise DataError(f"initial_state is one of {known}, not {initial_state!r}.")
    if history is not None and history < 0:
        raise DataError(f"a history cannot be negative, but {history=}.")
    layout = layout_of(rollouts, segment_length)
    if history is None:
        history = default_history(rollouts.time_step, len(layout), len(rollouts.action_names))
    return cut(rollouts, layout, initial_state=initial_state, history=history, dtype=dtype)


def cut(
    rollouts: Recording,
    layout: Sequence[tuple[int, int, int]],
    *,
    initial_state: InitialState,
    history: int,
    dtype: torch.dtype,
) -> Inputs:
    """Returns chosen segments of rollouts; see :meth:`Rollouts.inputs`.

    Args:
        rollouts: The rollouts.
        layout: Rollout, first step and end of each segment, in the order of the rollouts.
        initial_state: How the state at a segment's start is found.
        history: Steps of past commands to include.
        dtype: Floating-point type of the tensors.
    """
    num_steps = max(stop - start for _, start, stop in layout)
    num_actions = len(rollouts.action_names)
    actions = np.zeros((len(layout), num_steps, num_actions))
    past = np.zeros((len(layout), history, num_actions))
    mask = np.zeros((len(layout), num_steps), dtype=bool)
    readings = np.zeros((len(layout), len(rollouts.channel_names)))
    for row, (rollout, start, stop) in enumerate(layout):
        actions[row, : stop - start] = rollouts.actions[rollout][start:stop]
        known = min(history, start)
        past[row, history - known :] = rollouts.actions[rollout][start - known : start]
        mask[row, : stop - start] = True
        readings[row] = rollouts.readings[rollout][start]
    starts: dict[str, NDArray[np.float64]] = {"initial_values": readings}
    is_zero = np.stack((readings == 0.0, np.zeros_like(readings, dtype=bool)), axis=1)
    if initial_state != "recorded":
        estimate = _estimated(rollouts, layout)
        starts = {"initial_values": estimate.values, "initial_rates": estimate.rates}
        if initial_state == "uncertain":
            starts["initial_value_errors"] = estimate.value_errors
            starts["initial_rate_errors"] = estimate.rate_errors
        is_zero = estimate.is_zero
    is_first = np.array([start == 0 for _, start, _ in layout])[:, None, None]
    sampling = {"is_zero": torch.tensor(is_zero & is_first)}
    if rollouts.samplings:
        sampling |= {
            "is_read": torch.tensor(_compared(rollouts, layout, num_steps)),
            "lateness": torch.tensor(
                _after_steps(rollouts, layout, num_steps, "lateness"), dtype=dtype
            ),
        }
    initial: dict[str, Any] = {
        name: torch.tensor(value, dtype=dtype) for name, value in starts.items()
    }
    return Inputs(
        actions=torch.tensor(actions, dtype=dtype),
        action_names=rollouts.action_names,
        initial_readings=torch.tensor(readings, dtype=dtype),
        channel_names=rollouts.channel_names,
        past_actions=torch.tensor(past, dtype=dtype),
        time_step=rollouts.time_step,
        mask=torch.tensor(mask),
        rollout=torch.tensor([rollout for rollout, _, _ in layout]),
        start=torch.tensor([start for _, start, _ in layout]),
        **_whole_rollouts(rollouts, dtype),
        **sampling,
        **initial,
    )


def _whole_rollouts(rollouts: Recording, dtype: torch.dtype) -> dict[str, Tensor]:
    """Returns commands and measurements of whole rollouts, each unless it takes over 32 MiB."""
    num_steps = max(rollouts.lengths)
    most = _MOST_PAST_VALUES / (len(rollouts) * num_steps)
    found: dict[str, Tensor] = {}
    if len(rollouts.action_names) <= most:
        found["recorded_actions"] = _padded(rollouts.actions, num_steps, dtype)
    if len(rollouts.channel_names) <= most:
        found["recorded_readings"] = _recorded(rollouts, num_steps, dtype)
    return found


def _recorded(rollouts: Recording, num_steps: int, dtype: torch.dtype) -> Tensor:
    """Returns the measurements before each step, ``(R, T, C)``; missing ones are interpolated."""
    result = np.zeros((len(rollouts), num_steps, len(rollouts.channel_names)))
    for row, readings in zip(result, rollouts.readings, strict=True):
        for column, values in zip(row.T, readings[:num_steps].T, strict=True):
            known = np.isfinite(values).nonzero()[0]
            if len(known):
                column[:] = np.interp(np.arange(num_steps), known, values[known])
    return torch.tensor(result, dtype=dtype)


def observation(
    rollouts: Recording, inputs: Inputs | int | None, channels: Sequence[str] | None
) -> Tensor:
    """Returns the measurements after each step; see :meth:`Rollouts.observation`."""
    names = rollouts.channel_names if channels is None else tuple(channels)
    columns = columns_of(names, rollouts.channel_names)
    if isinstance(inputs, Inputs):
        starts = zip(inputs.rollout.tolist(), inputs.start.tolist(), strict=True)
        counts = inputs.mask.sum(-1).tolist()
        layout = [(r, start, start + n) for (r, start), n in zip(starts, counts, strict=True)]
        num_steps, dtype = inputs.num_steps, inputs.actions.dtype
        for rollout, _, stop in layout:
            if rollout >= len(rollouts) or stop > rollouts.lengths[rollout]:
                raise DataError("the inputs were made of other rollouts than these.")
    else:
        layout = layout_of(rollouts, inputs)
        num_steps, dtype = max(stop - start for _, start, stop in layout), torch.float64
    result = _after_steps(rollouts, layout, num_steps, "values")[..., columns]
    return torch.tensor(result, dtype=dtype)


def _padded(series: Sequence[NDArray[np.float64]], num_steps: int, dtype: torch.dtype) -> Tensor:
    """Returns the first steps of series, ``(R, num_steps, columns)``, with zeros at their ends."""
    result = np.zeros((len(series), num_steps, series[0].shape[-1]))
    for row, values in zip(result, series, strict=True):
        known = values[:num_steps]
        row[: len(known)] = known
    return torch.tensor(result, dtype=dtype)


def _after_steps(
    rollouts: Recording,
    layout: Sequence[tuple[int, int, int]],
    num_steps: int,
    part: Literal["values", "lateness", "is_read"],
) -> NDArray[Any]:
    """Returns a part of the sampling after each step, ``(S, K, C)``, zero beyond a segment."""
    if rollouts.samplings:
        source = [getattr(sampling, part) for sampling in rollouts.samplings]
    else:
        assert part == "values"
        source = list(rollouts.readings)
    shape = (len(layout), num_steps, len(rollouts.channel_names))
    result = np.zeros(shape, dtype=source[0].dtype)
    for row, (rollout, start, stop) in enumerate(layout):
        result[row, : stop - start] = source[rollout][start + 1 : stop + 1]
    return result


def _compared(
    rollouts: Recording, layout: Sequence[tuple[int, int, int]], num_steps: int
) -> NDArray[np.bool_]:
    """Returns where segments are compared with a measurement, ``(S, K, C)``.

    At the first and the last step of a segment, measurements that lie more than half a step
    outside of it are left out. A simulation would have to be extrapolated to them.
    """
    result = _after_steps(rollouts, layout, num_steps, "is_read")
    lateness = _after_steps(rollouts, layout, num_steps, "lateness")
    segment = np.arange(len(layout))
    last = np.array([stop - start - 1 for _, start, stop in layout])
    result[:, 0] &= lateness[:, 0] >= -NEAREST
    result[segment, last] &= lateness[segment, last] <= NEAREST
    return result


def stitch(
    trajectory: Tensor, inputs: Inputs, channels: Sequence[str] | None = None
) -> list[Tensor]:
    """Joins simulated segments into series of the states *before* each step, per rollout.

    Each segment contributes its initial value and all simulated values but the last. The series of
    a rollout can then be compared with :meth:`Rollouts.series`, as the paper's metrics need.

    Args:
        trajectory: Simulated values after each step, ``(..., S, K, C)``.
        inputs: Inputs of the simulation, S segments of K steps.
        channels: Names of the trajectory's channels; those of the inputs if ``None``.

    Returns:
        One ``(..., T, C)`` per rollout.

    Raises:
        DataError: A channel has no initial value because it was not recorded.
        ShapeError: The trajectory does not fit the inputs.
    """
    names = inputs.channel_names if channels is None else tuple(channels)
    shape = (inputs.num_segments, inputs.num_steps, len(names))
    if tuple(trajectory.shape[-3:]) != shape:
        raise ShapeError(
            f"a trajectory of these inputs ends in the shape {shape}, got "
            f"{tuple(trajectory.shape)}."
        )
    start = inputs.initial_values[..., columns_of(names, inputs.channel_names)]
    start = start.to(trajectory)[..., None, :].expand(*trajectory.shape[:-2], 1, len(names))
    states = torch.cat([start, trajectory[..., :-1, :]], dim=-2)
    result = []
    for rollout in torch.unique(inputs.rollout).tolist():
        rows = torch.nonzero(inputs.rollout == rollout)[:, 0]
        rows = rows[torch.argsort(inputs.start[rows])]
        pieces = [states[..., row, inputs.mask[row], :] for row in rows.tolist()]
        result.append(torch.cat(pieces, dim=-2))
    return result


def layout_of(rollouts: Recording, segment_length: int | None) -> list[tuple[int, int, int]]:
    """Returns rollout, first step and end of every segment of the usable stretches.

    Args:
        rollouts: The rollouts.
        segment_length: Number of steps; ``None`` for whole stretches. The last segment of a
            stretch may be shorter.

    Raises:
        DataError: The length is less than one.
    """
    if segment_length is not None and segment_length < 1:
        raise DataError(f"a segment has at least one step, but {segment_length=}.")
    return [
        (rollout, start, min(start + (segment_length or end - first), end))
        for rollout, spans in enumerate(rollouts.spans)
        for first, end in spans
        for start in range(first, end, segment_length or end - first)
    ]


def motion(rollouts: Recording, segment_length: int | None) -> torch.Tensor:
    """Returns how much each segment moves, ``(S,)``; see :func:`layout_of`.

    It is :func:`motion_by_channel`, summed over the channels.
    """
    return motion_by_channel(rollouts, segment_length).sum(-1)


def motion_by_channel(rollouts: Recording, segment_length: int | None) -> torch.Tensor:
    """Returns how much each channel moves in each segment, ``(S, C)``; see :func:`layout_of`.

    It is the distance between the quartiles of a channel in the segment, which single wrong
    readings do not change, relative to the channel's standard deviation.
    """
    found = []
    with warnings.catch_warnings():
        # A channel may have no readings in a segment; it then counts as still.
        warnings.simplefilter("ignore", RuntimeWarning)
        spread = np.nanstd(np.concatenate(rollouts.readings), axis=0)
        for rollout, start, end in layout_of(rollouts, segment_length):
            readings = rollouts.readings[rollout][start : end + 1]
            low, high = np.nanquantile(readings, [0.25, 0.75], axis=0)
            found.append(np.nan_to_num((high - low) / np.where(spread > 0.0, spread, np.inf)))
    return torch.tensor(np.array(found), dtype=torch.float64)


def _estimated(rollouts: Recording, layout: Sequence[tuple[int, int, int]]) -> StateEstimate:
    """Returns the estimated initial states of the segments, ``(S, C)``; computed only once."""
    known, key = rollouts.estimates, tuple(layout)
    if key not in known:
        known[key] = _estimate(rollouts, layout)
    return known[key]


def _estimate(rollouts: Recording, layout: Sequence[tuple[int, int, int]]) -> StateEstimate:
    parts = []
    for index, readings in enumerate(rollouts.readings):
        is_read = rollouts.samplings[index].is_read if rollouts.samplings else None
        own = [start for rollout, start, _ in layout if rollout == index]
        for first, end in rollouts.spans[index]:
            starts = np.array([start - first for start in own if first <= start < end], dtype=int)
            if not len(starts):
                continue
            rows = slice(first, end + 1)
            taken = None if is_read is None else is_read[rows]
            parts.append(estimate_states(readings[rows], starts, rollouts.time_step, taken))
    return StateEstimate(
        *(
            np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(StateEstimate)
        )
    )
