"""Do a fixed set of commands still give the results that they gave before?

    python benchmarks/same_results.py --data swing_up_500hz_5s.csv --out before
    ... change the code ...
    python benchmarks/same_results.py --data swing_up_500hz_5s.csv --out after --recordings before
    python benchmarks/same_results.py --compare before after --renamed renamed.json

Fits, a comparison, discovery on three recordings, a short training and the nominal column of Table
2 run through the command line. Every JSON file they write is compared number by number, but for
times, versions and paths. ``renamed.json`` maps old keys to new ones. The exit code is 1 if
anything differs.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

SINGLE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NPDR_NUM_THREADS": "1"}

SHORT_TRAINING = [
    "--target", "furuta-easy", "--iterations", "1", "--rounds", "1", "--simulations", "200",
    "--segment-length", "40", "--backend", "snpe-c(epochs=5, members=2)",
    "--search", "power(population=3)", "--search-iterations", "2", "--domains", "4",
]  # fmt: skip

TABLE2 = ["--backends", "bayesian-linear-regression"]
"""The quickest column; the nominal one is next to it."""

IGNORED = {"seconds", "version", "versions", "path", "folder", "file", "command", "created"}
IGNORED |= {"cpu_seconds", "peak_memory", "memory", "platform", "provenance", "out", "data"}
"""Keys of values that may differ from run to run."""


def commands(recordings: Path, data: Path) -> dict[str, list[str]]:
    """Returns the words of each command by name, but for its folder of results."""

    def on(name: str) -> list[str]:
        return ["--data", str(recordings / f"{name}.csv"), "--holdout", "3", "--quiet"]

    return {
        "fit": ["fit", "pendulum", *on("pendulum")],
        "fit_other": ["fit", "cart_pole", *on("cart_pole"), "--backend", "nle"],
        "compare": [
            "compare", "pendulum", *on("pendulum"), "--simulations", "300",
            "--backends", "snpe-c, bayessim, small = snpe-c(hidden=(32,))",
        ],
        "discover_none": ["discover", "pendulum", *on("pendulum")],
        "discover_drag": ["discover", "pendulum", *on("drag")],
        "discover_delay": ["discover", "emps", *on("delay")],
        "train": ["train", "furuta", *SHORT_TRAINING],
        "table2": ["reproduce", "table2", "--data", str(data), *TABLE2],
    }  # fmt: skip


def write_recordings(folder: Path) -> None:
    """Writes the recordings, by integrators and laws of the benchmarks' own."""
    from clean_fits_subjects import recorded
    from hidden_rigs import make_case

    folder.mkdir(parents=True, exist_ok=True)
    for subject in ("pendulum", "cart_pole"):
        rollouts = recorded(subject, 3).rollouts
        assert rollouts is not None
        rollouts.to_csv(folder / f"{subject}.csv")
    hidden = {
        "drag": ("pendulum", "hinge", "quadratic_drag"),
        "delay": ("emps", "voltage", "input_delay"),
    }
    for name, (rig, port, effect) in hidden.items():
        case = make_case(rig, "one", ((port, effect),), strength=1.0, seed=2001)
        case.fit.to_csv(folder / f"{name}.csv")


def run_all(out: Path, recordings: Path, data: Path, only: set[str]) -> int:
    """Runs the commands, notes what each took, and returns how many failed."""
    seconds, failed = {}, 0
    for name, words in commands(recordings, data).items():
        if only and name not in only:
            continue
        started = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "npdr_ppl.cli", *words, "--out", str(out / name)],
            env={**os.environ, **SINGLE_THREAD, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        seconds[name] = round(time.perf_counter() - started, 1)
        print(f"{name}: exit code {done.returncode}, {seconds[name]} s", flush=True)
        if done.returncode:
            failed += 1
            print(done.stderr, file=sys.stderr)
    (out / "wall_clock.txt").write_text(json.dumps(seconds, indent=2))
    return failed


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yields every value of nested dictionaries and lists with the keys that lead to it."""
    if isinstance(value, dict):
        for key, part in value.items():
            if key not in IGNORED:
                yield from leaves(part, f"{place}/{key}")
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from leaves(part, f"{place}/{index}")
    else:
        yield place, value


def are_equal(one: Any, other: Any) -> bool:
    """Returns whether two values are the same up to rounding in the last digits."""
    if isinstance(one, float) and isinstance(other, float):
        if math.isnan(one) and math.isnan(other):
            return True
        return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    return one == other


def compare(before: Path, after: Path, renamed: dict[str, str]) -> int:
    """Prints every difference and returns their number."""
    differences = 0
    known = {
        renamed.get(n, n) for n in (str(p.relative_to(before)) for p in before.rglob("*.json"))
    }
    for path in sorted(after.rglob("*.json")):
        if str(path.relative_to(after)) not in known:
            print(f"{path.relative_to(after)}: new")
            differences += 1
    for path in sorted(before.rglob("*.json")):
        name = path.relative_to(before)
        other = after / renamed.get(str(name), str(name))
        if not other.exists():
            print(f"{name}: missing")
            differences += 1
            continue
        old = {
            "/".join(renamed.get(part, part) for part in place.split("/")): value
            for place, value in leaves(json.loads(path.read_text()))
        }
        new = dict(leaves(json.loads(other.read_text())))
        for place in sorted(old.keys() | new.keys()):
            here, there = old.get(place, "absent"), new.get(place, "absent")
            if not are_equal(here, there):
                differences += 1
                print(f"{name}{place}: {here!r} -> {there!r}"[:300])
    print(f"{differences} differences")
    return differences


def main() -> int:
    """Runs the commands or compares their results; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, help="swing-ups of the paper's Furuta pendulum")
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--recordings", type=Path, help="folder whose recordings to use again")
    parser.add_argument("--only", default="", help="names of commands, separated by commas")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"))
    parser.add_argument("--renamed", type=Path, help="JSON file: old key or file to new one")
    chosen = parser.parse_args()
    if chosen.compare:
        renamed = json.loads(chosen.renamed.read_text()) if chosen.renamed else {}
        return min(1, compare(*chosen.compare, renamed))
    if chosen.data is None:
        parser.error("--data is needed to run the commands")
    recordings = (chosen.recordings or chosen.out) / "recordings"
    if chosen.recordings is None:
        write_recordings(recordings)
    out, only = chosen.out.resolve(), {name for name in chosen.only.split(",") if name}
    return min(1, run_all(out, recordings.resolve(), chosen.data.resolve(), only))


if __name__ == "__main__":
    sys.exit(main())
