"""Discovery of laws inside servos, on one-joint arms: named, value, CPU seconds.

    python benchmarks/servo_laws.py --out servo_laws.jsonl
    python benchmarks/servo_laws.py --summary servo_laws.jsonl

A user has the arm's MJCF file, whose gains, damping and armature are wrong by up to 20 %, and a
log of goals and positions. Each case hides one law, or none, in a rig with equations of its own;
see :mod:`servo_law_rigs`. It is searched by ``npdr discover arm.xml`` with all defaults in a
process of its own, with the whole catalogue. Rows are written as they come, and a run given again
continues.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

# The copy of the package beside this file is judged, wherever another is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from clean_fits_runs import npdr_command, run  # noqa: E402
from discovery_rows import large_effects  # noqa: E402
from servo_arms_rows import judged  # noqa: E402
from servo_law_rigs import KINDS, ROLLOUTS, make_case, mjcf  # noqa: E402

SEARCHED = tuple(kind for kind in KINDS if kind != "carrier")
"""Kinds of which a search considers the law without being asked."""


def judge(kind: str, seed: int, limit: float) -> dict[str, Any]:
    """Makes a case, searches it, and returns the row.

    Args:
        kind: What is hidden.
        seed: Seed of the case.
        limit: Seconds after which the search is ended.
    """
    case = make_case(kind, seed)
    row: dict[str, Any] = {
        "kind": kind,
        "seed": seed,
        "truth": [case.truth] if case.truth else [],
        "values": case.values,
        "is_in_catalogue": True,
        "condition": "one" if case.truth else "none",
    }
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "arm.xml").write_text(mjcf())
        case.rollouts.to_npz(folder / "rec.npz")
        command = npdr_command(
            "discover", str(folder / "arm.xml"), folder / "rec.npz", folder / "out", ROLLOUTS - 1
        )
        outcome = run(command, time_limit=limit)
        row |= {
            "message": outcome.message,
            "seconds": outcome.seconds,
            "cpu_seconds": outcome.cpu_seconds,
        }
        if not outcome.message:
            found = json.loads((folder / "out" / "discovery.json").read_text())
            row |= {"verdict": found["verdict"], "effects": found["effects"]}
    return row | judged(row) | {"errors": errors(row)}


def errors(row: dict[str, Any]) -> dict[str, float]:
    """Returns the relative error of each parameter of the hidden effect, if it was found."""
    for finding in row.get("effects", []):
        if f"{finding['port']}.{finding['effect']}" in row["truth"]:
            return {
                name: finding["parameters"][name]["mean"] / value - 1.0
                for name, value in row["values"].items()
            }
    return {}


def told(row: dict[str, Any]) -> str:
    """Returns a row in one line."""
    if row["message"]:
        return f"{row['kind']} {row['seed']}: {row['message']}"
    names = ", ".join(f"{e['port']}.{e['effect']}" for e in large_effects(row)) or "nothing"
    word = "right" if row["is_right"] else "WRONG"
    values = ", ".join(f"{name} {100 * error:+.1f} %" for name, error in row["errors"].items())
    return (
        f"{row['kind']} {row['seed']}: {word}, {row['verdict']}: {names}; {values or '–'}; "
        f"{row['cpu_seconds']:.0f} s of CPU"
    )


def print_summary(file: Path) -> None:
    """Prints a table by kind."""
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    print("| hidden | right | errors of its parameters | CPU seconds, median |")
    print("|---|---|---|---|")
    for kind in KINDS:
        own = [row for row in rows if row["kind"] == kind]
        if not own:
            continue
        right = sum(row["is_right"] for row in own)
        sizes = [abs(e) for row in own for e in row["errors"].values()]
        seconds = median(row["cpu_seconds"] for row in own)
        shown = "–"
        if sizes:
            shown = f"median {100 * median(sizes):.1f} %, worst {100 * max(sizes):.1f} %"
        print(f"| {kind.replace('_', ' ')} | {right} of {len(own)} | {shown} | {seconds:.0f} |")


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="Discovery of laws inside servos.")
    parser.add_argument("--kinds", default=",".join(SEARCHED))
    parser.add_argument("--num-seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds for each search")
    parser.add_argument("--out", type=Path, default=Path("servo_laws.jsonl"))
    parser.add_argument("--summary", type=Path, help="only summarise this file")
    arguments = parser.parse_args()
    if arguments.summary:
        print_summary(arguments.summary)
        return
    done = set()
    if arguments.out.exists():
        rows = map(json.loads, arguments.out.read_text().splitlines())
        done = {(row["kind"], row["seed"]) for row in rows}
    for number in range(arguments.num_seeds):
        for kind in arguments.kinds.split(","):
            seed = arguments.first_seed + number
            if (kind, seed) in done:
                continue
            row = judge(kind, seed, arguments.limit)
            with arguments.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(told(row), flush=True)
    print_summary(arguments.out)


if __name__ == "__main__":
    main()
