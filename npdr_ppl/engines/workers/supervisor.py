"""Supervises one worker's process: starts it, sends it draws, kills and replaces it."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from npdr_ppl.engines.workers.faults import Fault, Faults
from npdr_ppl.engines.workers.safe_path import inherited_environment
from npdr_ppl.engines.workers.task import Draw
from npdr_ppl.errors import NpdrError, SimulationError

__all__ = ["Chunk", "ChunkResult", "Supervisor"]

SET_UP_SECONDS = 300.0
"""Time limit, in seconds, for loading a task and for setting it up."""

MAX_FAILED_STARTS = 3
"""Number of process starts in a row that may fail: enough to tolerate chance failures, and few
enough to stop early if every start fails."""

# Lets the template import the same modules as this process, even modules that are not installed.
_BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[2]); "
    "from npdr_ppl.engines.workers.template import main; main(int(sys.argv[1]))"
)

# One core per worker, because threads of numerical libraries would compete for the cores.
_ONE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS",
    )
}  # fmt: skip


_CRASHED: tuple[Any, Any] = Fault.CRASHED, ""


@dataclass(frozen=True)
class Chunk:
    """Draws that are sent to a worker together.

    Attributes:
        task: The pickled task.
        digest: Identifies the task.
        path: The caller's module search path; workers of a cluster use it after their own.
        draws: The draws.
        time_limit: Seconds that one draw may take.
        retries: How often a failed draw is repeated.
    """

    task: bytes
    digest: str
    path: tuple[str, ...]
    draws: tuple[Draw, ...]
    time_limit: float
    retries: int


@dataclass
class ChunkResult:
    """The outcome of a chunk.

    Attributes:
        values: Results by index; ``None`` for a lost draw.
        faults: Faults of the chunk.
        error: Reason why no draw of this task can succeed, if there is one.
    """

    values: dict[int, np.ndarray | None] = field(default_factory=dict)
    faults: Faults = field(default_factory=Faults)
    error: Exception | None = None


class Supervisor:
    """Runs chunks of draws in a separate process, and survives any failure of that process.

    After a fault the process is not used again. Another fork of the
    :mod:`~npdr_ppl.engines.workers.template` replaces it.
    """

    def __init__(self) -> None:
        self._template: _Template | None = None
        self._loaded = ""
        self._data: Connection | None = None

    def run(self, chunk: Chunk) -> ChunkResult:
        """Runs all draws of a chunk; faults are part of the result and raise no exception."""
        result = ChunkResult()
        try:
            faults = self._run(chunk, result.values)
            result.faults = replace(faults, num_draws=len(chunk.draws))
            self._rest()
        except NpdrError as error:
            result.error = error
            self.close()
        except BaseException:  # most likely Ctrl-C
            self.close()
            raise
        return result

    def close(self) -> None:
        """Stops the worker's processes."""
        if self._data is not None:
            self._data.close()
            self._data = None
        if self._template is not None:
            self._template.close()
            self._template = None
        self._loaded = ""

    def _run(self, chunk: Chunk, values: dict[int, np.ndarray | None]) -> Faults:
        """Writes results to ``values`` and returns the faults."""
        faults = Faults()
        queue = deque(chunk.draws)
        is_sent = False
        self._wake(chunk)
        while queue:
            if self._data is None:
                self._data, is_sent = self._start(chunk), False
            if not is_sent:
                is_sent = self._send(queue)
            fault, value = self._receive(chunk.time_limit) if is_sent else _CRASHED
            draw = queue.popleft()
            if fault is None:
                values[draw.index] = value
                continue
            if fault == "refused":
                raise value
            self._end_child()
            is_again = draw.attempt < chunk.retries
            faults += Faults.of(fault, draw.index, is_retried=is_again, example=value)
            if is_again:
                queue.append(replace(draw, attempt=draw.attempt + 1))
            else:
                values[draw.index] = None
        return faults

    def _send(self, draws: Sequence[Draw]) -> bool:
        """Sends draws; returns whether the process was alive to receive them."""
        assert self._data is not None
        try:
            self._data.send(list(draws))
        except OSError:
            return False
        return True

    def _receive(self, seconds: float) -> tuple[Any, Any]:
        """Returns the process's next answer, or a fault if there was none."""
        assert self._data is not None
        try:
            if not self._data.poll(seconds):
                return Fault.HUNG, ""
            return self._data.recv()
        except (EOFError, OSError):
            return _CRASHED

    def _start(self, chunk: Chunk) -> Connection:
        """Forks a process that has set up the task.

        Raises:
            SimulationError: The task cannot be loaded or set up.
        """
        for _ in range(MAX_FAILED_STARTS):
            try:
                data = self._loaded_template(chunk).spawn()
            except (EOFError, OSError):  # the template was killed from outside
                self.close()
                continue
            self._data = data
            fault, value = self._receive(SET_UP_SECONDS)
            if fault is None:
                return data
            if fault == "refused":
                raise value
            self._end_child()
            if fault is Fault.RAISED:
                raise SimulationError(f"A worker could not set up its task: {value}")
        raise SimulationError(
            f"A worker's process ended or hung {MAX_FAILED_STARTS} times in a row while it set up "
            "its task; see its messages on standard error."
        )

    def _loaded_template(self, chunk: Chunk) -> "_Template":
        """Returns a template that has loaded the chunk's task."""
        if self._template is None:
            self._template = _Template()
        if self._loaded != chunk.digest:
            reply = self._template.ask("load", chunk.task, chunk.path)
            if reply:
                raise SimulationError(f"A worker could not load its task:\n{reply}")
            self._loaded = chunk.digest
        return self._template

    def _wake(self, chunk: Chunk) -> None:
        """Keeps the processes of the last chunk only if they are alive and have the same task."""
        if self._template is None:
            return
        try:
            self._template.ask("wake")
            if self._loaded != chunk.digest:
                self._end_child()
        except (EOFError, OSError):
            self.close()

    def _rest(self) -> None:
        """Lets the processes stop by themselves if no chunk follows for a long time."""
        if self._template is not None:
            with suppress(OSError):
                self._template.tell("rest")

    def _end_child(self) -> None:
        if self._data is not None:
            self._data.close()
            self._data = None
        if self._template is not None:
            try:
                self._template.ask("end")
            except (EOFError, OSError):
                self.close()


def _environment() -> dict[str, str]:
    """Returns the environment of a template.

    Dask sets its workers' allocator to return memory to the system at once. An engine that builds
    a scene for each draw would then request every page again and be three times as slow.
    """
    inherited = inherited_environment()
    kept = {name: v for name, v in inherited.items() if name != "MALLOC_TRIM_THRESHOLD_"}
    return kept | _ONE_THREAD


class _Template:
    """The supervisor's interface to the template process."""

    def __init__(self) -> None:
        if not hasattr(os, "fork"):
            raise SimulationError("Workers need a system that can fork: Linux or macOS.")
        ours, theirs = socket.socketpair()
        self._process = subprocess.Popen(
            # Without -P, the first import would look for a module in the current folder.
            [sys.executable, "-P", "-c", _BOOT, str(theirs.fileno()), json.dumps(sys.path)],
            pass_fds=(theirs.fileno(),),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # engines print, but a command's output may be JSON
            env=_environment(),
            start_new_session=True,
        )
        theirs.close()
        self._channel = ours
        self._control = Connection(os.dup(ours.fileno()))
        self._child: int | None = None

    def tell(self, command: str, *values: Any) -> None:
        """Sends a command that has no answer."""
        self._control.send((command, *values))

    def ask(self, command: str, *values: Any) -> Any:
        """Sends a command and returns the answer.

        Raises:
            EOFError, OSError: The template has ended or does not answer in time.
        """
        self.tell(command, *values)
        return self._answer()

    def spawn(self) -> Connection:
        """Forks a child and returns this side's end of its connection."""
        ours, theirs = socket.socketpair()
        with ours, theirs:
            self.tell("spawn")
            socket.send_fds(self._channel, [b"x"], [theirs.fileno()])
            theirs.close()
            self._child = self._answer()
            return Connection(ours.detach())

    def close(self) -> None:
        """Stops the template and its child."""
        self._control.close()
        self._channel.close()
        if self._child is None:
            self._process.kill()  # it may be loading for seconds, and there is no child to stop
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.returncode != 0 and self._child is not None:
            # The template was killed and could not stop its child and what that one started.
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._child, signal.SIGKILL)

    def _answer(self) -> Any:
        if not self._control.poll(SET_UP_SECONDS):
            raise EOFError("The template does not answer.")
        return self._control.recv()
