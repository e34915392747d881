"""Checks of names, values, time stamps and files; each failure is one sentence."""

import re
import reprlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError, NpdrError
from npdr_ppl.reading_limits import LIMITS

__all__ = [
    "RESERVED_NAMES",
    "canonical_time_step",
    "check_file",
    "check_finite",
    "check_names",
    "check_time",
    "check_time_step",
    "check_times",
    "check_values",
    "check_unit_texts",
    "named",
    "refusing",
    "shown",
]

RESERVED_NAMES = ("rollout", "time", "reward", "step")
"""Names that have a fixed meaning in every file format."""

MAX_MAGNITUDE = 1e100
"""Largest magnitude of a value. No measurement in SI units is larger, and the square of this
number is still a finite float64."""

MAX_STEP_JITTER = 0.1
"""Largest deviation of a time step from the median step that counts as constant sampling, as a
fraction of the median step. Time stamps rounded to milliseconds at 30 Hz deviate by 0.03."""

MAX_RATE_DIFFERENCE = 0.01
"""Largest relative difference between the time steps of two rollouts that is attributed to the
clock."""

_VALUES_TOGETHER = 100_000
"""Number of values of short rollouts that are checked together. A call of NumPy costs as much as a
thousand values; more of them together would take much memory."""

_FORBIDDEN_IN_NAMES = re.compile(r"[,;\"'/\\]")
_MAX_NAME_LENGTH = 100
_MAX_UNIT_LENGTH = 30

_ABRIDGED = reprlib.Repr()
_ABRIDGED.maxtuple = _ABRIDGED.maxlist = _ABRIDGED.maxdict = 10
_ABRIDGED.maxlevel = 2


def shown(value: object, limit: int = 40) -> str:
    """Returns a printable, shortened form of any value, for messages.

    The time it takes is bounded for any value, also for one that contains itself many times.
    """
    is_text = isinstance(value, str | bytes)
    shown_whole = repr(value[: limit + 1]) if is_text else _ABRIDGED.repr(value)
    if not shown_whole.isprintable():
        shown_whole = ascii(shown_whole)
    if len(shown_whole) <= limit:
        return shown_whole
    return shown_whole[: limit - 2] + "…" + (shown_whole[-1] if is_text else "")


@contextmanager
def named(path: str | PathLike[str]) -> Iterator[None]:
    """Prefixes the message of every DataError raised inside the block with a file's name."""
    try:
        yield
    except DataError as error:
        # The folder "." has no name.
        name = Path(path).name or str(path)
        raise DataError(f"{name if name.isprintable() else ascii(name)}: {error}") from None


@contextmanager
def refusing(kind: str) -> Iterator[None]:
    """Turns any error that a library raises for a malformed file into a DataError.

    Args:
        kind: What the file should be, e.g. ``"Parquet file"``.
    """
    try:
        yield
    except NpdrError:
        raise
    except MemoryError:
        raise DataError(f"the {kind} does not fit into memory.") from None
    # Decoders raise nearly any error for corrupt bytes; for the caller all mean the same.
    except Exception as error:
        raise DataError(f"not a readable {kind} ({type(error).__name__}).") from None


def check_file(path: str | PathLike[str]) -> Path:
    """Returns ``path`` if it names a file of acceptable size.

    Raises:
        DataError: It is missing, a directory, not a regular file, unreadable, empty or too large.
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
        if status.st_size > LIMITS.file_bytes:
            raise DataError(
                f"the file has {status.st_size / 2**30:.1f} GiB, more than the "
                f"{LIMITS.file_bytes / 2**30:.0f} GiB that are read."
            )
    return path


def _neighbour(path: Path) -> str:
    """Returns a suggestion of a file with nearly the same name, if there is one."""
    try:
        beside = [other.name for other in path.parent.iterdir()]
    except (OSError, ValueError):
        return ""
    close = get_close_matches(path.name, beside, n=1)
    return f" Did you mean {path.with_name(close[0])}?" if close else ""


def check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Returns column names as a tuple after checking that every format can store them.

    Args:
        names: Names of columns.

    Raises:
        DataError: A name is empty, repeated, or has characters that a format cannot store.
    """
    seen: set[str] = set()
    for position, name in enumerate(names, start=1):
        if not isinstance(name, str) or not name.strip():
            raise DataError(f"column {position} has no name.")
        is_plain = name.isprintable() and name.strip() == name
        if (
            not (name[0].isalpha() or name[0] == "_")
            or not is_plain
            or _FORBIDDEN_IN_NAMES.search(name)
            or len(name) > _MAX_NAME_LENGTH
        ):
            raise DataError(
                f"column {position} is called {shown(name)}, but names begin with a letter, have "
                f"at most {_MAX_NAME_LENGTH} characters and no comma, semicolon, quote or slash."
            )
        if name in seen:
            raise DataError(f"the column {shown(name)} appears twice.")
        seen.add(name)
    return tuple(names)


def check_unit_texts(units: Sequence[str], names: Sequence[str]) -> None:
    """Checks that units are short, printable text; there is one for each name, or none at all.

    Raises:
        DataError: A unit is longer than any unit, or has characters that cannot be printed.
    """
    for name, unit in zip(names, units, strict=False):
        if not isinstance(unit, str) or len(unit) > _MAX_UNIT_LENGTH or not unit.isprintable():
            raise DataError(
                f"the unit of {name} is {shown(unit)}, but units have at most {_MAX_UNIT_LENGTH} "
                "printable characters."
            )


def check_values(rollouts: Sequence[NDArray[np.float64]], names: Sequence[str]) -> None:
    """Raises a DataError if values of a rollout, ``(T, len(names))`` each, are not plausible."""
    for batch in _batches(rollouts):
        if batch.stop - batch.start > 1 and not _is_bad(np.concatenate(rollouts[batch])).any():
            continue
        for index in range(batch.start, batch.stop):
            check_finite(rollouts[index], names, f"rollout {index}")


def check_times(times: Sequence[NDArray[np.float64]]) -> None:
    """Raises a DataError unless each rollout's time stamps increase in equal steps.

    Args:
        times: Time stamps of each rollout, ``(T + 1,)`` with T of at least 1, in s.
    """
    for batch in _batches(times):
        if batch.stop - batch.start > 1 and _are_even(times[batch]):
            continue
        for index in range(batch.start, batch.stop):
            check_time(times[index], f"rollout {index}")


def _batches(arrays: Sequence[NDArray[np.float64]]) -> Iterator[slice]:
    """Yields groups of rollouts that are checked together; a long rollout is alone."""
    first, total = 0, 0
    for index, values in enumerate(arrays):
        total += values.size
        if total > _VALUES_TOGETHER and index > first:
            yield slice(first, index)
            first, total = index, values.size
    yield slice(first, len(arrays))


def _are_even(times: Sequence[NDArray[np.float64]]) -> bool:
    """Returns whether the steps of each rollout surely differ too little for an error.

    The usual step lies between the smallest and the largest one. If these two differ by less than
    the tolerance, no step differs by more from the usual one.
    """
    counts = np.array([len(time) for time in times])
    steps = np.delete(np.diff(np.concatenate(times)), np.cumsum(counts[:-1]) - 1)
    firsts = np.cumsum(counts - 1) - (counts - 1)
    least, most = (f.reduceat(steps, firsts) for f in (np.minimum, np.maximum))
    return bool(((least > 0) & (most - least <= MAX_STEP_JITTER * least)).all())


def _is_bad(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return ~(np.abs(values) <= MAX_MAGNITUDE)


def check_finite(values: NDArray[np.float64], names: Sequence[str], where: str) -> None:
    """Raises a DataError if values ``(T, len(names))`` are not finite or above MAX_MAGNITUDE."""
    is_bad = _is_bad(values)
    if is_bad.any():
        step, column = np.argwhere(is_bad)[0]
        raise DataError(
            f"{names[column]} is {values[step, column]} at step {step} of {where}, which is not "
            "a finite number of plausible size."
        )


def check_time(time: NDArray[np.float64], where: str) -> None:
    """Raises a DataError unless time stamps ``(T + 1,)``, in s, increase in equal steps."""
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


def check_time_step(time_step: float) -> None:
    """Raises a DataError unless a time step, in s, is from a nanosecond to thirty years."""
    if not 1e-9 <= time_step <= 1e9:
        raise DataError(f"the time step is {time_step:.6g} s, which is implausible.")


def canonical_time_step(times: Sequence[NDArray[np.float64]]) -> float:
    """Returns the common time step, in s, of the time stamps of all rollouts.

    Time stamps ``k·Δt`` give exactly ``Δt``. Others give the mean step of the longest rollout,
    rounded to 12 digits to remove the rounding errors of the stamps.

    Args:
        times: Time stamps of each rollout, ``(T + 1,)``, in s.

    Raises:
        DataError: The rollouts were sampled at different rates, or the step is implausible.
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
    check_time_step(time_step)
    for index, time in enumerate(times):
        own = float(time[-1] - time[0]) / (len(time) - 1)
        allowed = max(MAX_RATE_DIFFERENCE, MAX_STEP_JITTER / (len(time) - 1)) * time_step
        if abs(own - time_step) > allowed:
            raise DataError(
                f"rollout {index} has a time step of {own:.6g} s, but another one has "
                f"{time_step:.6g} s; give each sampling rate its own file."
            )
    return time_step
