"""Runs a command as a new user would, and measures what it takes."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import npdr_ppl

__all__ = ["Outcome", "npdr_command", "run"]

POLL = 0.2
"""Seconds between looks at the memory."""

TIME_LIMIT = 3600.0
"""Seconds after which a command is ended."""

SINGLE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NPDR_NUM_THREADS": "1"}

ROOT = Path(npdr_ppl.__file__).parents[1]
"""Where the package is that this process has imported: the command imports the same."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a command.

    Attributes:
        exit_code: Its exit code; negative for the signal that ended it.
        message: The last line on standard error if it failed.
        cpu_seconds: CPU time of its processes.
        seconds: Wall-clock time.
        peak_bytes: Greatest memory of all its processes together, shared pages counted once,
            seen every ``POLL`` seconds, or the greatest resident set of the first if larger.
    """

    exit_code: int
    message: str
    cpu_seconds: float
    seconds: float
    peak_bytes: int


def npdr_command(verb: str, model: str, data: Path, out: Path, holdout: int) -> list[str]:
    """Returns ``npdr fit`` or ``npdr discover`` with all defaults."""
    command = [sys.executable, "-m", "npdr_ppl.cli", verb, model]
    return [*command, "--data", str(data), "--holdout", str(holdout), "--out", str(out)]


def run(command: Sequence[str], *, time_limit: float = TIME_LIMIT) -> Outcome:
    """Runs a command on one thread.

    Args:
        command: Program and arguments.
        time_limit: Seconds after which it is ended.
    """
    environment = {**os.environ, **SINGLE_THREAD, "PYTHONPATH": str(ROOT)}
    started = time.perf_counter()
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,  # so that its workers can be ended with it
        )
        peak, is_late = 0, False
        while True:
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            peak = max(peak, memory_of(process.pid))
            if not is_late and time.perf_counter() - started > time_limit:
                os.killpg(process.pid, signal.SIGKILL)
                is_late = True
            time.sleep(POLL)
        process.returncode = os.waitstatus_to_exitcode(status)  # or Popen would wait for it
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
    if is_late:
        message = f"ended after {time_limit:g} s"
    elif process.returncode == 0:
        message = ""
    else:
        message = lines[-1][:300] if lines else "no message"
    return Outcome(
        process.returncode,
        message,
        usage.ru_utime + usage.ru_stime,
        time.perf_counter() - started,
        peak,
    )


def memory_of(pid: int) -> int:
    """Returns the memory of a process and its descendants in bytes; 0 if it has gone.

    The resource usage of a child that was forked has its parent's memory in it, so it is read
    from ``/proc``: proportional shares, which count a page that processes share once.
    """
    together = sum(_field(f"/proc/{member}/smaps_rollup", "Pss") for member in _family(pid))
    return max(together, _field(f"/proc/{pid}/status", "VmHWM"))


def _family(pid: int) -> list[int]:
    """Returns a process and all its descendants."""
    found = [pid]
    for member in found:
        try:
            for task in os.listdir(f"/proc/{member}/task"):
                children = Path(f"/proc/{member}/task/{task}/children").read_text()
                found.extend(int(child) for child in children.split())
        except OSError:  # it has gone
            continue
    return found


def _field(path: str, name: str) -> int:
    """Returns a size in a file of ``/proc``, in bytes; 0 if the process has gone."""
    try:
        lines = Path(path).read_text().splitlines()
    except OSError:
        return 0
    for line in lines:
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    return 0
