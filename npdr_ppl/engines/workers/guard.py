"""A process that ends a Ray cluster of our own when the process that started it has ended.

Ray's workers and agents outlive a killed driver, by a minute or without limit. The guard lists the
cluster's processes twice a second. When its standard input closes, because its parent closes the
cluster or has ended in any way, it kills those that are left. It runs as a script and imports the
standard library only, so that it starts quickly. Without /proc, it does nothing.

The templates of simulations (see ``template.py``) are spared: they end by themselves with the
worker above them, and end the programs that simulations have started.
"""

import contextlib
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

__all__ = ["guarded_cluster"]

INTERVAL = 0.5
"""Seconds between two lists: little work, and few processes are started shortly before the end."""

MOST_ROUNDS = 50
"""Times that processes are killed, 0.1 s apart, because they may start others in the meantime."""

RAY = b"/ray/"
"""Part of the command line of a cluster's own processes: the folder of the package."""

WORKER = b"/ray/_private/"
"""Part of the command line of a cluster's processes that are written in Python."""

SESSION = re.compile(rb"session_[0-9][0-9_-]+")
"""Name of a cluster's session in the command lines of its processes."""

TEMPLATE = b"npdr_ppl.engines.workers.template"
"""Part of the command line of a template."""


@contextlib.contextmanager
def guarded_cluster() -> Iterator[None]:
    """Ends the Ray cluster that is started inside the block at its end, or with this process."""
    with subprocess.Popen(
        [sys.executable, "-P", "-S", __file__, str(os.getpid())],
        stdin=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is for the parent only
    ) as guard:
        assert guard.stdin is not None
        try:
            yield
        finally:
            guard.stdin.close()
            guard.wait()


def _processes() -> dict[int, tuple[int, str]]:
    """Returns the parent and the start time of all running processes."""
    found = {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended in the meantime
            state, parent, *rest = file.read_text().rpartition(")")[2].split()
            if state != "Z":
                found[int(file.parent.name)] = int(parent), rest[17]
    return found


def _command_line(process: int) -> bytes:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/cmdline").read_bytes()
    return b""


def _is_worker(process: int, session: bytes) -> bool:
    """Returns whether a process runs a program of Ray for a session."""
    words = _command_line(process)
    return session in words and WORKER in words


def _below(roots: set[int], processes: dict[int, tuple[int, str]]) -> set[int]:
    """Returns processes with their descendants, without templates and what is below them."""
    found = new = set(roots)
    while new:
        new = {
            process
            for process, (parent, _) in processes.items()
            if parent in new and process not in found and TEMPLATE not in _command_line(process)
        }
        found = found | new
    return found


def main() -> None:
    """Runs the guard; its argument is the number of the process that starts the cluster."""
    parent = int(sys.argv[1])
    known: dict[int, str] = {}
    session = b""
    while True:
        processes = _processes()
        roots = {p for p, (above, _) in processes.items() if above == parent}
        roots = {p for p in roots if RAY in _command_line(p) and p != os.getpid()}
        known |= {p: processes[p][1] for p in _below(roots, processes)}
        if not session and (named := SESSION.search(b" ".join(map(_command_line, roots)))):
            session = named.group()
        if select.select([0], [], [], INTERVAL)[0] and not os.read(0, 1):
            break
    for _ in range(MOST_ROUNDS):
        processes = _processes()
        if session:  # the parent of workers that started since the last list may have ended
            known |= {p: start for p, (_, start) in processes.items() if _is_worker(p, session)}
        alive = {p for p, start in known.items() if processes.get(p, (0, ""))[1] == start}
        if not alive:
            break
        for process in _below(alive, processes):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        time.sleep(0.1)


if __name__ == "__main__":
    main()
