"""Checks that a recording fits a simulator: columns, units and no duplicate rollouts."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.recording import Recording

__all__ = [
    "OTHER_UNITS",
    "check_channels",
    "check_declared_units",
    "check_duplicates",
    "check_units",
    "limited_commands",
]

OTHER_UNITS = {"rad": ("degrees", 180 / math.pi), "m": ("millimetres", 1000.0)}
"""Common units other than SI: by SI unit, the other unit's name and how many equal one SI unit."""

SMALLEST_SHARE = 1e-5
"""A channel that moves, but never beyond this share of its bound, is in another unit: the encoders
and sensors of robots do not resolve so little."""


def check_duplicates(recording: Recording) -> None:
    """Raises a DataError if two rollouts are identical to the last bit.

    Two recordings of a device never are, so the same file was probably added twice.
    """
    seen: dict[bytes, int] = {}
    for index, (readings, actions) in enumerate(
        zip(recording.readings, recording.actions, strict=True)
    ):
        key = readings.tobytes() + actions.tobytes()
        if key in seen:
            raise DataError(
                f"rollouts {seen[key]} and {index} are identical; was one recording added twice?"
            )
        seen[key] = index


def check_channels(
    recording: Recording,
    channels: Sequence[Channel],
    actions: Sequence[Channel],
    *,
    allow_extra: bool = False,
) -> None:
    """Checks that the data have the columns a simulator needs, and no others.

    A velocity may be missing if its position was recorded; its initial values are then estimated
    from the position.

    Args:
        recording: The data.
        channels: Expected state or sensor channels.
        actions: Expected actions.
        allow_extra: Accept channels that are not expected. Extra actions are never accepted.

    Raises:
        DataError: A column is missing or extra, or an action was read as a channel.
    """
    recorded = set(recording.channel_names)
    for action in actions:
        if action.name in recorded and action.name not in recording.action_names:
            raise DataError(
                f"{action.name} is an action, but its cells in the last row of each rollout are "
                "not empty; empty them if that row is the one measured after the last step, "
                "otherwise append such a row (or, in Python, read with "
                f"actions=[{action.name!r}])."
            )
    missing = [a.name for a in actions if a.name not in recording.action_names]
    # A rate follows from its position, which is named if it is missing itself.
    known = recorded | {channel.name for channel in channels}
    missing += [c.name for c in channels if c.name not in recorded and c.rate_of not in known]
    found = ", ".join((*recording.channel_names, *recording.action_names))
    some = any(channel.name in recorded for channel in channels)
    if missing:
        raise DataError(
            f"{_columns(missing)} missing; the data have {found}. If a log has "
            "other names, --mapping gives it the model's; npdr inspect LOG --model MODEL --write "
            "mapping.toml writes one to start from."
            + (" Joints that the log lacks can be made fixed in a robot's file." if some else "")
        )
    expected_actions = {action.name for action in actions}
    extra = [name for name in recording.action_names if name not in expected_actions]
    if not allow_extra:
        expected = {channel.name for channel in channels}
        extra += [name for name in recording.channel_names if name not in expected]
    if extra:
        it = "it" if len(extra) == 1 else "them"
        raise DataError(
            f"{_columns(extra)} not expected; remove {it}, or give {it} the name of a channel of "
            f"the model: {', '.join(c.name for c in (*channels, *actions))}."
        )


def check_declared_units(recording: Recording, channels: Sequence[Channel]) -> None:
    """Raises a DataError if the data state another unit than a simulator's channel has.

    Args:
        recording: The data.
        channels: State, sensor or action channels with units.
    """
    units = dict(zip(recording.channel_names, recording.channel_units, strict=True))
    units |= dict(zip(recording.action_names, recording.action_units, strict=True))
    for channel in channels:
        own = units.get(channel.name, "")
        if own and channel.unit and own != channel.unit:
            raise DataError(f"{channel.name} is in {own}, but {channel.unit} is expected.")


def check_units(recording: Recording, channels: Sequence[Channel]) -> None:
    """Checks the units and signs of columns, e.g. finds degrees or millimetres instead of SI.

    Three symptoms show another unit. A range exceeds the declared bounds by the factor between the
    units, it is a tiny share of them, or a position's derivative differs from the measured rate by
    this factor.

    Args:
        recording: The data.
        channels: State, sensor or action channels with units, bounds and ``rate_of``.

    Raises:
        DataError: A column is probably in another unit.
    """
    units = dict(zip(recording.channel_names, recording.channel_units, strict=True))
    units |= dict(zip(recording.action_names, recording.action_units, strict=True))
    for channel in channels:
        if channel.name in units:
            _check_range(recording, channel)
    for channel in channels:
        if channel.name in recording.channel_names and channel.rate_of in recording.channel_names:
            unit = channel.unit.removesuffix("/s")
            _check_rate(recording, channel.name, channel.rate_of, unit)


def limited_commands(recording: Recording, actions: Sequence[Channel]) -> tuple[Remark, ...]:
    """Returns remarks on commands that simulators limit because a model's range ends before them.

    Args:
        recording: The data.
        actions: A simulator's actions with their ranges.
    """
    remarks = []
    for action in actions:
        if action.name not in recording.action_names:
            continue
        values = np.concatenate(_column(recording, action.name))
        # Commands at a bound may be rounded to single precision.
        bounds = [abs(b) for b in (action.lower, action.upper) if math.isfinite(b)]
        slack = 1e-6 * max(bounds, default=0.0)
        beyond = (values < action.lower - slack) | (values > action.upper + slack)
        if not beyond.any():
            continue
        unit = f" {action.unit}" if action.unit not in ("", "1") else ""
        remarks.append(
            Remark(
                f"{100.0 * beyond.mean():.3g} % of the commands {action.name} are beyond the "
                f"model's range, {action.lower:.4g} to {action.upper:.4g}{unit}; simulations "
                "limit them to it."
            )
        )
    return tuple(remarks)


def _columns(names: Sequence[str]) -> str:
    """Returns the names of columns as the subject of a sentence, with its verb."""
    listed = ", ".join(names)
    return f"the column {listed} is" if len(names) == 1 else f"the columns {listed} are"


def _column(recording: Recording, name: str) -> list[NDArray[np.float64]]:
    if name in recording.channel_names:
        index = recording.channel_names.index(name)
        return [readings[:, index] for readings in recording.readings]
    index = recording.action_names.index(name)
    return [actions[:, index] for actions in recording.actions]


def _check_range(recording: Recording, channel: Channel) -> None:
    largest = max(float(np.max(np.abs(values))) for values in _column(recording, channel.name))
    bound = max(abs(channel.lower), abs(channel.upper))
    # Sensors may exceed a bound by a few per cent, but not by several times the bound.
    if math.isfinite(bound) and largest > 3 * bound:
        other, factor = OTHER_UNITS.get(channel.unit.removesuffix("/s"), ("", 0.0))
        is_other = largest <= 1.1 * bound * factor
        reason = f"are these {other}?" if is_other else "check the unit."
        raise DataError(
            f"{channel.name} reaches {largest:.4g} {channel.unit}, far beyond its bound of "
            f"{bound:.4g} {channel.unit}; {reason}"
        )
    if math.isfinite(bound) and 0 < largest < SMALLEST_SHARE * bound:
        raise DataError(
            f"{channel.name} never exceeds {largest:.4g} {channel.unit}, far below its bound of "
            f"{bound:.4g} {channel.unit}; check the unit."
        )


def _check_rate(recording: Recording, rate: str, position: str, unit: str) -> None:
    """Compares the displacement of a position with the integral of its rate.

    Net displacements over a window of 0.1 s are insensitive to quantisation and to the low-pass
    filter of a driver. Both would disturb a comparison of derivatives at each sample.
    """
    window = max(1, round(0.1 / recording.time_step))
    moved: list[NDArray[np.float64]] = []
    integrated: list[NDArray[np.float64]] = []
    columns = _column(recording, position), _column(recording, rate)
    for positions, rates in zip(*columns, strict=True):
        stride = min(window, len(positions) - 1)
        area = np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2)])
        moved.append(positions[stride::stride] - positions[:-stride:stride])
        integrated.append((area[stride::stride] - area[:-stride:stride]) * recording.time_step)
    x, y = np.concatenate(integrated), np.concatenate(moved)
    size = float(np.linalg.norm(x)) * float(np.linalg.norm(y))
    # If the two curves differ in shape, their ratio says nothing about units.
    if size == 0 or abs(float(x @ y)) < 0.7 * size:
        return
    if float(x @ y) < 0:
        raise DataError(f"{position} falls where {rate} says that it rises; one sign is wrong.")
    ratio = float(np.linalg.norm(y) / np.linalg.norm(x))
    si = {"rad": "radians", "m": "metres"}.get(unit, "")
    other, factor = OTHER_UNITS.get(unit, ("", 0.0))
    for one, two, times in ((other, si, factor), (si, other, 1 / factor if factor else 0.0)):
        if 0.7 * times < ratio < 1.4 * times:
            raise DataError(
                f"the derivative of {position} is {ratio:.3g} times {rate}: {position} seems to "
                f"be in {one} and {rate} in {two} per second."
            )
