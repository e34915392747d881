"""A journal of an episode on a device: every step is on disk before the next one is made.

A line per step, JSON: what the controller saw and what it commanded; a last line with the readings
at the end marks the episode as complete. A process killed in mid-episode leaves what was recorded
until then; one killed right after it leaves a whole episode.
"""

import json
from pathlib import Path

import numpy as np

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import Array, Controller, TargetDomain

__all__ = ["Journal", "read_journal"]


class Journal:
    """A controller that notes every step of its episode before the command leaves.

    Args:
        controller: What decides on the commands.
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
        """Returns the commands, ``(actions,)``, for readings ``(sensors,)`` at a time in s."""
        commands = np.array(self._controller(readings, time), dtype=np.float64, ndmin=1)
        self.commands.append(commands)
        self._write({"readings": readings.tolist(), "commands": commands.tolist()})
        return commands

    def end(self, readings: Array) -> None:
        """Notes that the episode is complete, with its last readings ``(sensors,)``, once."""
        if not self._is_complete:
            self._write({"end": readings.tolist()})
        self._is_complete = True

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _write(self, line: dict[str, list[float]]) -> None:
        if self._file is not None:
            # Line-buffered, so the operating system has it even if the process is killed.
            self._file.write(json.dumps(line) + "\n")


def read_journal(path: Path, target: TargetDomain) -> tuple[Rollouts | None, Array, bool]:
    """Returns what a journal holds.

    Args:
        path: The file.
        target: The device it was written for.

    Returns:
        The rollout with the limits of the target applied, ``None`` if there is not one whole step;
        the commands before any limit, ``(T, actions)``; whether the episode was complete.

    Raises:
        DataError: A line other than the last is not readable.
    """
    readings: list[list[float]] = []
    commands: list[list[float]] = []
    is_complete = False
    lines = path.read_text().splitlines()
    for number, text in enumerate(lines):
        try:
            line = json.loads(text)
        except ValueError:
            if number == len(lines) - 1:  # the kill came while it was written
                break
            raise DataError(f"{path}: line {number + 1} is not JSON.") from None
        if "end" in line:
            readings.append(line["end"])
            is_complete = True
        else:
            readings.append(line["readings"])
            commands.append(line["commands"])
    commands = commands[: max(0, len(readings) - 1)]
    raw = np.array(commands, dtype=np.float64).reshape(len(commands), len(target.actions))
    if not commands:
        return None, raw, is_complete
    return target.rollout(readings, [target.limit(row) for row in raw]), raw, is_complete
