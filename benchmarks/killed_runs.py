"""Kills runs of the NPDR loop at random moments, and compares what comes out of them when resumed.

    python benchmarks/killed_runs.py --kills 100
    python benchmarks/killed_runs.py --kills 10 --mode discover

Prints the number of kills and in how many different states of its folder a run was killed. The
exit code is 1 if a resumed run differs from the undisturbed one, or if the target ran an episode
twice.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Kills the runs and prints a line of JSON for every mode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=100, help="Number of kills in each mode.")
    parser.add_argument("--mode", choices=["plain", "check", "discover"], action="append")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    is_wrong = False
    for mode in options.mode or ["plain", "check"]:
        with tempfile.TemporaryDirectory() as folder:
            words = ["-m", "tests.helpers.kill_runs", folder, options.kills, options.seed, mode]
            print(f"{mode}:", flush=True)
            done = subprocess.run(
                [sys.executable, *map(str, words)],
                cwd=ROOT,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                check=False,
            )
            is_wrong |= done.returncode != 0
    return int(is_wrong)


if __name__ == "__main__":
    sys.exit(main())
