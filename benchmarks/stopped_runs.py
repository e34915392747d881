"""Ends fits by SIGTERM and SIGKILL at random moments, and counts the processes that they leave.

    python benchmarks/stopped_runs.py --stops 50
    python benchmarks/stopped_runs.py --stops 10 --executors loky,ray

The model's simulator starts a program for every simulation; one in twenty hangs while two programs
run, one of them in a session of its own. Prints a row for each stop. The exit code is 1 if a
process is left ``--limit`` seconds after the signal, or if SIGTERM does not end with its sentence.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

HEADER = (
    "executor", "signal", "after, s", "running", "exit code", "workers gone, s", "all gone, s",
    "left",
)  # fmt: skip


def main() -> int:
    """Runs the stops and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--stops", type=int, default=50, help="Number of stops in all.")
    parser.add_argument("--executors", default="serial,loky,dask,ray")
    parser.add_argument("--limit", type=float, default=10.0, help="s until all must be gone.")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    executors = options.executors.split(",")
    each = -(-options.stops // len(executors))
    script = ROOT / "tests" / "helpers" / "stop_runs.py"
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}", flush=True)
    is_wrong = False
    with tempfile.TemporaryDirectory() as folder:
        words = [script, folder, options.executors, each, options.seed, options.limit]
        with subprocess.Popen(
            [sys.executable, *map(str, words)],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            text=True,
        ) as run:
            assert run.stdout is not None
            for line in run.stdout:
                row = json.loads(line)
                says = row["signal"] == "SIGKILL" or "npdr: interrupted" in row["errors"]
                is_wrong |= bool(row["left"]) or not says
                cells = [row["executor"], row["signal"], row["after"], row["running"]]
                cells += [row["exit_code"], row["workers_seconds"], row["seconds"]]
                cells.append(len(row["left"]))
                print(f"| {' | '.join(map(str, cells))} |", *row["left"], flush=True)
                if not says or row["left"]:
                    print(row["errors"], flush=True)
    return int(is_wrong or run.returncode != 0)


if __name__ == "__main__":
    sys.exit(main())
