"""What is wrong with data, each answered with one sentence."""

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel

if TYPE_CHECKING:
    from npdr_ppl.rollouts.container import Rollouts

__all__ = [
    "RESERVED_NAMES",
    "canonical_time_step",
    "check_channels",
    "check_duplicates",
    "check_file",
    "check_finite",
    "check_names",
    "check_time",
    "check_units",
    "named",
    "shown",
]

RESERVED_NAMES = ("rollout", "time", "reward", "step")
"""Names with a meaning of their own in every file format."""

MAX_FILE_BYTES = 2**30
"""Larger files are refused before they are read: a day at 1 kHz with ten channels is below it."""

MAX_MAGNITUDE = 1e100
"""No reading in SI units is larger, and its square is still a finite float64."""

MAX_STEP_JITTER = 0.1
"""Deviation of a time step from the median step that still counts as constant sampling; time
stamps rounded to milliseconds at 30 Hz deviate by 0.03."""

MAX_RATE_DIFFERENCE = 0.01
"""Relative difference between the time steps of two rollouts that a clock may explain."""

OTHER_UNITS = {"rad": ("degrees", 180 / math.pi), "m": ("millimetres", 1000.0)}
"""What people record instead of SI units, and how many of them one SI unit has."""

_FORBIDDEN_IN_NAMES = re.compile(r"[,;\"'/\\]")
_MAX_NAME_LENGTH = 100


def shown(value: object, limit: int = 40) -> str:
    """Returns a printable, shortened form of anything, for messages."""
    is_text = isinstance(value, str | bytes)
    shown_whole = repr(value) if is_text else str(value)
    if not shown_whole.isprintable():
        shown_whole = ascii(shown_whole)
    if len(shown_whole) <= limit:
        return shown_whole
    return shown_whole[: limit - 2] + "…" + (shown_whole[-1] if is_text else "")


@contextmanager
def named(path: str | PathLike[str]) -> Iterator[None]:
    """Puts a file's name before the message of every DataError raised inside the block."""
    try:
        yield
    except DataError as error:
        # The folder "." has no name.
        name = Path(path).name or str(path)
        raise DataError(f"{name if name.isprintable() else ascii(name)}: {error}") from None


def check_file(path: str | PathLike[str]) -> Path:
    """Returns ``path`` if it names a file of acceptable size.

    Raises:
        DataError: It is missing, a directory, not a regular file, unreadable, empty or huge.
    """
    path = Path(path)
    with named(path):
        try:
            status = path.stat()
            is_file, is_directory = path.is_file(), path.is_dir()
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else None
            raise DataError(
                f"cannot be opened ({reason or 'not a path'}).{_neighbour(path)}"
            ) from None
        if is_directory:
            raise DataError("is a directory, but a file is needed.")
        if not is_file:
            raise DataError("is not a regular file.")
        if status.st_size == 0:
            raise DataError("the file is empty.")
        if status.st_size > MAX_FILE_BYTES:
            raise DataError(
                f"the file has {status.st_size / 2**30:.1f} GiB, more than the "
                f"{MAX_FILE_BYTES / 2**30:.0f} GiB that are read."
            )
    return path


def _neighbour(path: Path) -> str:
    """Returns a question for a file of nearly the same name, if there is one."""
    try:
        beside = [other.name for other in path.parent.iterdir()]
    except (OSError, ValueError):
        return ""
    close = get_close_matches(path.name, beside, n=1)
    return f" Did you mean {path.with_name(close[0])}?" if close else ""


def check_names(names: Sequence[str], kind: str) -> tuple[str, ...]:
    """Returns column names as a tuple after checking that every format can carry them.

    Args:
        names: Names of columns.
        kind: What they name, for the message: ``"channel"``, ``"action"`` or ``"column"``.

    Raises:
        DataError: A name is empty, repeated, or has characters that a format cannot carry.
    """
    seen: set[str] = set()
    for position, name in enumerate(names, start=1):
        if not isinstance(name, str) or not name.strip():
            raise DataError(f"{kind} {position} has no name.")
        is_plain = name.isprintable() and name.strip() == name
        if (
            not (name[0].isalpha() or name[0] == "_")
            or not is_plain
            or _FORBIDDEN_IN_NAMES.search(name)
            or len(name) > _MAX_NAME_LENGTH
        ):
            raise DataError(
                f"{kind} {position} is called {shown(name)}, but names begin with a letter, have "
                f"at most {_MAX_NAME_LENGTH} characters and no comma, semicolon, quote or slash."
            )
        if name in seen:
            raise DataError(f"the {kind} {shown(name)} appears twice.")
        seen.add(name)
    return tuple(names)


def check_finite(values: NDArray[np.float64], names: Sequence[str], where: str) -> None:
    """Raises a DataError where values ``(T, len(names))`` are not finite or absurdly large."""
    with np.errstate(invalid="ignore"):
        is_bad = ~(np.abs(values) <= MAX_MAGNITUDE)
    if is_bad.any():
        step, column = np.argwhere(is_bad)[0]
        raise DataError(
            f"{names[column]} is {values[step, column]} at step {step} of {where}, which is not "
            "a finite number of plausible size."
        )


def check_time(time: NDArray[np.float64], where: str) -> None:
    """Raises a DataError unless time stamps ``(T + 1,)``, in s, rise in equal steps."""
    steps = np.diff(time)
    if (steps <= 0).any():
        at = int(np.argmax(steps <= 0))
        raise DataError(
            f"time goes from {time[at]:.9g} to {time[at + 1]:.9g} s in {where}; it must increase."
        )
    usual = float(np.sort(steps)[(len(steps) - 1) // 2])
    is_off = np.abs(steps - usual) > MAX_STEP_JITTER * usual
    if is_off.any():
        at = int(np.argmax(is_off))
        raise DataError(
            f"the step from {time[at]:.9g} to {time[at + 1]:.9g} s in {where} differs from the "
            f"usual {usual:.6g} s; resample the data to constant sampling."
        )


def canonical_time_step(times: Sequence[NDArray[np.float64]]) -> float:
    """Returns the one time step, in s, behind the time stamps of all rollouts.

    Time stamps ``k·Δt`` give back exactly ``Δt``; others give the mean step of the longest
    rollout, rounded to 12 digits so that the rounding of the stamps does not show.

    Args:
        times: Time stamps of each rollout, ``(T + 1,)``, in s.

    Raises:
        DataError: The rollouts were sampled at different rates, or the step is absurd.
    """
    longest = max(times, key=len)
    num_steps = len(longest) - 1
    first = float(longest[1] - longest[0])
    grid = longest[0] + first * np.arange(num_steps + 1)
    rounding = 4 * np.finfo(np.float64).eps * float(np.max(np.abs(longest)))
    if np.max(np.abs(grid - longest)) <= rounding:
        time_step = first
    else:
        time_step = float(f"{(longest[-1] - longest[0]) / num_steps:.12g}")
    if not 1e-9 <= time_step <= 1e9:
        raise DataError(f"the time step is {time_step:.6g} s, which is implausible.")
    for index, time in enumerate(times):
        own = float(time[-1] - time[0]) / (len(time) - 1)
        allowed = max(MAX_RATE_DIFFERENCE, MAX_STEP_JITTER / (len(time) - 1)) * time_step
        if abs(own - time_step) > allowed:
            raise DataError(
                f"rollout {index} has a time step of {own:.6g} s, but another one has "
                f"{time_step:.6g} s; give each sampling rate its own file."
            )
    return time_step


def check_duplicates(rollouts: "Rollouts") -> None:
    """Raises a DataError where two rollouts are the same to the last bit.

    Two recordings of a device never are; the same file was probably added twice.
    """
    seen: dict[bytes, int] = {}
    for index, (readings, actions) in enumerate(
        zip(rollouts.readings, rollouts.actions, strict=True)
    ):
        key = readings.tobytes() + actions.tobytes()
        if key in seen:
            raise DataError(
                f"rollouts {seen[key]} and {index} are identical; was one recording added twice?"
            )
        seen[key] = index


def check_channels(
    rollouts: "Rollouts",
    channels: Sequence[Channel],
    actions: Sequence[Channel],
    *,
    allow_extra: bool = False,
) -> None:
    """Checks that the data have the columns a simulator needs, and no others.

    A rate may be missing where the channel that it is the rate of was recorded: its value at a
    segment's start is then estimated.

    Args:
        rollouts: The data.
        channels: Expected state or sensor channels.
        actions: Expected actions.
        allow_extra: Accept channels that are not expected; extra actions never are.

    Raises:
        DataError: A column is missing, extra, or an action was read as a channel.
    """
    recorded = set(rollouts.channel_names)
    for action in actions:
        if action.name in recorded and action.name not in rollouts.action_names:
            raise DataError(
                f"{action.name} is an action, but its cells in the last row of each rollout are "
                "not empty; empty them if that row is the reading after the last step, otherwise "
                f"append such a row (or, in Python, read with actions=[{action.name!r}])."
            )
    missing = [a.name for a in actions if a.name not in rollouts.action_names]
    missing += [c.name for c in channels if c.name not in recorded and c.rate_of not in recorded]
    found = ", ".join((*rollouts.channel_names, *rollouts.action_names))
    if missing:
        raise DataError(f"the column {', '.join(missing)} is missing; the data have {found}.")
    expected_actions = {action.name for action in actions}
    extra = [name for name in rollouts.action_names if name not in expected_actions]
    if not allow_extra:
        expected = {channel.name for channel in channels}
        extra += [name for name in rollouts.channel_names if name not in expected]
    if extra:
        raise DataError(
            f"the column {', '.join(extra)} is not expected; remove it, or rename it to what it "
            f"is: the model knows {', '.join(c.name for c in (*channels, *actions))}."
        )


def check_units(rollouts: "Rollouts", channels: Sequence[Channel]) -> None:
    """Looks for columns in other units than declared, degrees or millimetres, or of wrong sign.

    Two things tell: a range that leaves the declared bounds by the factor between the units, and
    a position whose derivative is so many times the reading of its own rate. Declared units are
    compared where the data carry units.

    Args:
        rollouts: The data.
        channels: State, sensor or action channels with units, bounds and ``rate_of``.

    Raises:
        DataError: A column is probably in another unit.
    """
    units = dict(zip(rollouts.channel_names, rollouts.channel_units, strict=True))
    units |= dict(zip(rollouts.action_names, rollouts.action_units, strict=True))
    for channel in channels:
        own = units.get(channel.name, "")
        if own and channel.unit and own != channel.unit:
            raise DataError(f"{channel.name} is in {own}, but {channel.unit} is expected.")
    for channel in channels:
        if channel.name in units:
            _check_range(rollouts, channel)
    for channel in channels:
        if channel.name in rollouts.channel_names and channel.rate_of in rollouts.channel_names:
            unit = channel.unit.removesuffix("/s")
            _check_rate(rollouts, channel.name, channel.rate_of, unit)


def _column(rollouts: "Rollouts", name: str) -> list[NDArray[np.float64]]:
    if name in rollouts.channel_names:
        index = rollouts.channel_names.index(name)
        return [readings[:, index] for readings in rollouts.readings]
    index = rollouts.action_names.index(name)
    return [actions[:, index] for actions in rollouts.actions]


def _check_range(rollouts: "Rollouts", channel: Channel) -> None:
    largest = max(float(np.max(np.abs(values))) for values in _column(rollouts, channel.name))
    bound = max(abs(channel.lower), abs(channel.upper))
    # A few per cent of overshoot is a sensor's business, several times the bound is not.
    if math.isfinite(bound) and largest > 3 * bound:
        other, factor = OTHER_UNITS.get(channel.unit.removesuffix("/s"), ("", 0.0))
        is_other = largest <= 1.1 * bound * factor
        reason = f"are these {other}?" if is_other else "check the unit."
        raise DataError(
            f"{channel.name} reaches {largest:.4g} {channel.unit}, far beyond its bound of "
            f"{bound:.4g} {channel.unit}; {reason}"
        )


def _check_rate(rollouts: "Rollouts", rate: str, position: str, unit: str) -> None:
    """Compares how far the position went with the integral of its rate.

    Net displacements over a window are insensitive to quantisation and to a driver's low-pass,
    both of which spoil a comparison of derivatives sample by sample.
    """
    window = max(1, round(0.1 / rollouts.time_step))
    moved: list[NDArray[np.float64]] = []
    integrated: list[NDArray[np.float64]] = []
    for positions, rates in zip(_column(rollouts, position), _column(rollouts, rate), strict=True):
        stride = min(window, len(positions) - 1)
        area = np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2)])
        moved.append(positions[stride::stride] - positions[:-stride:stride])
        integrated.append((area[stride::stride] - area[:-stride:stride]) * rollouts.time_step)
    x, y = np.concatenate(integrated), np.concatenate(moved)
    size = float(np.linalg.norm(x)) * float(np.linalg.norm(y))
    # Without agreement in shape the ratio says nothing about units.
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
