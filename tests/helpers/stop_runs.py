"""Ends fits by signals at random moments, and counts what they leave running.

    python stop_runs.py FOLDER EXECUTORS NUM_STOPS SEED [LIMIT]

The model's simulator starts a program for every simulation, and a share of simulations hangs while
its program runs. Every process whose parent has ended becomes a child of this one, so none can
hide. Prints a row of JSON for each stop: the executor, the signal, after how many seconds it came,
the exit code, and what was left ``LIMIT`` seconds later.
"""

import contextlib
import ctypes
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.engines.test_safe_path import drifting

PR_SET_CHILD_SUBREAPER = 36
LIMIT = 10.0
"""Default of the seconds after which nothing may be left."""

LONGEST = {"serial": 15.0, "threads": 15.0, "loky": 20.0, "dask": 25.0, "ray": 30.0}
"""Longest time from the first worker to the signal, s: from starting to simulating, on a busy
machine."""

ROOT = Path(__file__).parents[2]

MODEL = """
import os
import subprocess

import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from tests.helpers.pooled_models import Drift


class Programs(Drift):
    def simulate_one(self, workspace, parameters, segment, seed):
        # One of them leaves the process group of the simulation.
        is_hanging = os.path.exists(HANG) and int(1e6 * parameters["gain"]) % 20 == 0
        subprocess.run(["sleep", "0.005"], check=True)
        if is_hanging:
            subprocess.Popen(["sleep", "600"], start_new_session=True)
            subprocess.run(["sleep", "600"], check=True)
        return super().simulate_one(workspace, parameters, segment, seed)


HANG = os.path.join(os.path.dirname(os.path.abspath(__file__)), "hang")


def model(inputs):
    gain = pyro.sample("gain", dist.Uniform(0.5, 2.0))
    return npdr.simulate("trajectory", Programs(0.0), {"gain": gain}, inputs, noise={"level": 0.1})
"""


def write_inputs(folder):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "own.py").write_text(MODEL)
    (folder / "hang").touch()
    drifting().to_csv(folder / "recording.csv")


def start(folder, executor):
    """Starts a fit on two workers."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "RAY_USAGE_STATS_ENABLED": "0",
        "OMP_NUM_THREADS": "1", "LOKY_MAX_CPU_COUNT": "2", "PYTHONFAULTHANDLER": "1",
    }  # fmt: skip
    workers = () if executor == "serial" else ("--workers", "2")
    with (folder / "errors").open("w") as errors:
        return subprocess.Popen(
            [sys.executable, "-m", "npdr_ppl.cli", "fit", "own.py:model", "--data",
             "recording.csv", "--simulations", "2000", "--simulation-limit", "5", "--quiet",
             "--executor", executor, *workers, "--out", "fit"],
            cwd=folder, env=environment, stderr=errors,
        )  # fmt: skip


def descendants():
    """Returns the command lines of the processes below this one, by process number."""
    parents, ended = {}, set()
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):  # it has ended in the meantime
                state, parent = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
                parents[int(folder.name)] = int(parent)
                if state == "Z":  # its threads, which may have children, may be about to end
                    ended.add(int(folder.name))
    found = {os.getpid()}
    while more := {process for process, parent in parents.items() if parent in found} - found:
        found |= more
    return {process: command_line(process) for process in found - ended - {os.getpid()}}


def command_line(process):
    with contextlib.suppress(OSError):
        words = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")
        return b" ".join(words).decode(errors="replace")[:100]
    return ""


def is_worker(run, process, words):
    """Returns whether a process is neither the command nor a tracker that ends with it."""
    return process != run.pid and "resource_tracker" not in words


def stop(folder, executor, number, seconds, limit):
    """Ends a fit by a signal, so long after its first worker was started; returns a row."""
    run = start(folder, executor)
    # The command's own imports take seconds in which there is nothing to leave behind.
    while len(descendants()) < 2 and run.poll() is None:
        time.sleep(0.01)
    time.sleep(seconds)
    running = len(descendants())
    was_alive = run.poll() is None
    run.send_signal(number)
    sent = time.monotonic()
    workers_seconds = None
    while (left := descendants()) and time.monotonic() < sent + limit:
        if workers_seconds is None and not any(
            is_worker(run, *process) for process in left.items()
        ):
            workers_seconds = time.monotonic() - sent
        time.sleep(0.05)
    seconds_left = time.monotonic() - sent
    if workers_seconds is None:
        workers_seconds = seconds_left
    if run.pid in left:
        run.send_signal(signal.SIGABRT)  # writes where it hangs to its errors
        with contextlib.suppress(subprocess.TimeoutExpired):
            run.wait(2.0)
    for process in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    run.wait()
    with contextlib.suppress(ChildProcessError):  # those adopted from the run
        while os.waitpid(-1, 0):
            pass
    return {
        "executor": executor, "signal": signal.Signals(number).name, "after": round(seconds, 2),
        "was_alive": was_alive, "running": running, "exit_code": run.returncode,
        "workers_seconds": round(workers_seconds, 2), "seconds": round(seconds_left, 2),
        "left": sorted(left.values()),
        "errors": (folder / "errors").read_text()[:20_000],
    }  # fmt: skip


def main():
    folder, executors, num_stops, seed = sys.argv[1:5]
    limit = float(sys.argv[5]) if len(sys.argv) > 5 else LIMIT
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    moments = random.Random(int(seed))
    write_inputs(Path(folder))
    for number in range(int(num_stops)):
        for executor in executors.split(","):
            # A run that has been stopped goes on; a finished one begins anew.
            if (Path(folder) / "fit" / "fit.json").exists():
                shutil.rmtree(Path(folder) / "fit")
            chosen = (signal.SIGTERM, signal.SIGKILL)[number % 2]
            row = stop(
                Path(folder), executor, chosen, moments.uniform(0.0, LONGEST[executor]), limit
            )
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
