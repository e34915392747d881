"""The supervisors of one process: reused for many chunks, and stopped with the process."""

import atexit
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock

from npdr_ppl.engines.workers.supervisor import Chunk, ChunkResult, Supervisor

__all__ = ["Crew", "run_chunk"]


class Crew:
    """Supervisors that wait for the next chunk, each with a process that has loaded a task."""

    def __init__(self) -> None:
        self._idle: list[Supervisor] = []
        self._busy: set[Supervisor] = set()
        self._lock = Lock()

    @contextmanager
    def supervisor(self) -> Iterator[Supervisor]:
        """Gives a supervisor to the block."""
        with self._lock:
            lent = self._idle.pop() if self._idle else Supervisor()
            self._busy.add(lent)
        try:
            yield lent
        finally:
            with self._lock:
                is_kept = lent in self._busy
                self._busy.discard(lent)
                if is_kept:
                    self._idle.append(lent)
            if not is_kept:  # the crew was closed in the meantime
                lent.close()

    def run(self, chunk: Chunk) -> ChunkResult:
        """Runs a chunk on one of the supervisors."""
        with self.supervisor() as supervisor:
            return supervisor.run(chunk)

    def close(self) -> None:
        """Stops all processes; a running supervisor stops its own after its chunk."""
        with self._lock:
            ended, self._idle, self._busy = self._idle, [], set()
        for supervisor in ended:
            supervisor.close()


@cache
def _crew_of_this_process() -> Crew:
    """Returns the crew of a process that an executor owns.

    Starting a process and loading an engine takes seconds, so the process must be kept after its
    chunk. An executor keeps only its own process between two chunks.
    """
    crew = Crew()
    atexit.register(crew.close)
    return crew


def run_chunk(chunk: Chunk) -> ChunkResult:
    """Runs a chunk in a process that an executor owns."""
    return _crew_of_this_process().run(chunk)
