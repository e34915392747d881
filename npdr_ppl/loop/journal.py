"""A journal of an episode on a device: every step is on disk before the next one begins.

Each step is one JSON line with the controller's measurements and commands. A last line with the
final measurements marks the episode as complete. If the process is killed during the episode, the
steps so far remain; if it is killed right after the episode, the whole episode remains.
"""

import json
from pathlib import Path

import msgspec
import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.reading_limits import LIMITS
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import read_bytes, reading_back
from npdr_ppl.targets.base import Array, Controller, TargetDomain

__all__ = ["Journal", "read_journal"]


class _Line(msgspec.Struct):
    """A step: measurements and commands, or the last measurements at the end."""

    readings: list[float] = []
    commands: list[float] = []
    end: list[float] | None = None


_DECODER = msgspec.json.Decoder(_Line)


class Journal:
    """A controller that writes down every step before the command is sent.

    Args:
        controller: The controller that computes the commands.
        path: The file; ``None`` keeps the commands in memory only.

    Attributes:
        commands: Commands so far, before any limit, ``(actions,)`` each.
    """

    def __init__(self, controller: Controller, path: Path | None) -> None:
        self.commands: list[Array] = []
        self._controller = controller
        self._is_complete = False
        self._file = None if path is None else path.open("w", buffering=1)

    def __call__(self, readings: Array, time: float) -> Array:
        """Returns the commands, ``(actions,)``, for measurements ``(sensors,)`` at a time in s."""
        commands = np.array(self._controller(readings, time), dtype=np.float64, ndmin=1)
        self.commands.append(commands)
        self._write({"readings": readings.tolist(), "commands": commands.tolist()})
        return commands

    def end(self, readings: Array) -> None:
        """Marks the episode as complete, once, with its last measurements ``(sensors,)``."""
        if not self._is_complete:
            self._write({"end": readings.tolist()})
        self._is_complete = True

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _write(self, line: dict[str, list[float]]) -> None:
        if self._file is not None:
            # Line-buffered, so the operating system has the line even if the process is killed.
            self._file.write(json.dumps(line) + "\n")


def read_journal(path: Path, target: TargetDomain) -> tuple[Rollouts | None, Array, bool]:
    """Reads a journal.

    Args:
        path: The file.
        target: The device for which it was written.

    Returns:
        The rollout with the limits of the target applied, ``None`` if there is not one whole step;
        the commands before any limit, ``(T, actions)``; whether the episode was complete.

    Raises:
        DataError: A line other than the last is not readable.
    """
    readings: list[list[float]] = []
    commands: list[list[float]] = []
    is_complete = False
    lines = read_bytes(path, LIMITS.file_bytes).splitlines()
    for number, text in enumerate(lines):
        try:
            line = _DECODER.decode(text)
        except (ValueError, RecursionError):
            if number == len(lines) - 1:  # the process was killed while writing it
                break
            raise DataError(f"{path}: line {number + 1} is not a step of an episode.") from None
        if line.end is not None:
            readings.append(line.end)
            is_complete = True
        else:
            readings.append(line.readings)
            commands.append(line.commands)
    commands = commands[: max(0, len(readings) - 1)]
    with reading_back(path):
        raw = np.array(commands, dtype=np.float64).reshape(len(commands), len(target.actions))
        if not commands:
            return None, raw, is_complete
        return target.rollout(readings, [target.limit(row) for row in raw]), raw, is_complete
