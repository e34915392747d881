"""Success on pendulums with one large hidden effect: the loop with discovery and without it.

    python benchmarks/hidden_policy_rigs.py --out rows.jsonl            # 30 rigs, both methods
    python benchmarks/hidden_policy_rigs.py --out rows.jsonl --rigs 6   # the first two of a kind
    python benchmarks/hidden_policy_rigs.py --out rows.jsonl --summary  # what the rows say
    python benchmarks/hidden_policy_rigs.py --out tried.jsonl --first 1000  # to try options on

The rigs are drawn from seeds before any run: ten of each kind, whose voltage is 15 to 25 ms late,
whose joints have 3 to 5 times the dry friction of the random rigs, or whose amplifier has a dead
zone of 0.3 to 0.6 V. They run in MuJoCo; the loop begins at the paper's equations without effects.
Each run may take three real rollouts: one of the default gains, one of the first trained policy,
and one that the loop may ask for. It is judged by three fresh episodes of the policy it ends with:
a run is a success if their mean return is above 1400. A row is written when a run is finished;
rows that the file holds are not run again.

Options were chosen on rigs with seeds from 1000; the seeds reported here begin at 0.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from policy_loop import DISCOVER, SUCCESS, changed

from npdr_ppl.discovery import DiscoveryOptions
from npdr_ppl.loop.control_task import control_task
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.models.furuta_hidden_rigs import HIDDEN, hidden_rig
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.reproduction.rig_study import METHODS, Outcome, run_method

WITH, WITHOUT = "npdr with discovery", "npdr"

OPTIONS = DISCOVER | {
    "extra_rollouts": 1,
    # A policy that has succeeded on the rig is kept.
    "stop_return": SUCCESS,
    "stops": "measured return",
    # One effect is hidden, at two joints where it is friction: a search for more takes minutes.
    "discovery": DiscoveryOptions(max_effects=2),
}


def rows_of(file: Path) -> list[dict]:
    """Returns the rows that a file holds; a line that was cut off is none."""
    if not file.exists():
        return []
    rows = []
    for line in file.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def planned(first: int, number: int, methods: list[str]) -> Iterator[tuple[str, int, str]]:
    """Yields kind, seed and method; kinds take turns, so that any leading part is balanced."""
    for rank in range(number):
        kind = HIDDEN[rank % len(HIDDEN)]
        for method in methods:
            yield kind, first + rank // len(HIDDEN), method


def row_of(kind: str, rig: int, method: str, seed: int) -> dict:
    """Runs the loop on one rig and returns its row."""
    name = f"furuta-{kind}-{rig}"
    hidden = hidden_rig(kind, rig)
    loop, options = changed(LoopOptions(), OPTIONS)
    started, spent = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        outcome = run_method(
            METHODS[method],
            furuta_target(name),
            control_task("furuta-swing-up"),
            loop,
            options=options,
            seed=seed,
            out=Path(folder) / "run",
            progress=False,
        )
    return {
        "rig": name,
        "kind": kind,
        "method": method,
        "seed": seed,
        "truth": {
            "input_delay": hidden.input_delay,
            "arm_friction": hidden.arm_friction,
            "pole_friction": hidden.pole_friction,
            "voltage_dead_zone": hidden.voltage_dead_zone,
        },
        **described(outcome),
        "seconds": round(time.perf_counter() - started, 1),
        "cpu_seconds": round(time.process_time() - spent, 1),
    }


def described(outcome: Outcome) -> dict:
    """Returns the outcome of a run as the figures of its row."""
    records = outcome.iterations
    return {
        "returns": [round(value, 1) for value in outcome.returns],
        "is_success": sum(outcome.returns) / len(outcome.returns) > SUCCESS,
        "real_rollouts": records[-1]["num_rollouts"] if records else 1,
        "iterations": [
            {
                "real_return": record["real_return"],
                "effects": record["effects"],
                "decisions": [decision["action"] for decision in record["decisions"]],
                "checks": record["checks"],
                "simulated_success": record.get("simulated_success"),
                "sim_success": record.get("sim_success"),
            }
            for record in records
        ],
    }


def summary(rows: list[dict]) -> str:
    """Returns the table: successes by method and kind, simulated success, time."""
    lines = []
    for method in (WITH, WITHOUT):
        of_method = [row for row in rows if row["method"] == method]
        for kind in (*HIDDEN, "all"):
            chosen = [row for row in of_method if kind in ("all", row["kind"])]
            if not chosen:
                continue
            good = sum(row["is_success"] for row in chosen)
            mean = sum(sum(r["returns"]) / len(r["returns"]) for r in chosen) / len(chosen)
            cpu = sorted(row["cpu_seconds"] for row in chosen)
            real = sum(row["real_rollouts"] for row in chosen) / len(chosen)
            share = good / len(chosen)
            lines.append(
                f"{method:20} {kind:10} {good:3} of {len(chosen):3} succeed ({share:4.0%}), mean "
                f"return {mean:5.0f}, {real:.1f} real rollouts, processor time median "
                f"{cpu[len(cpu) // 2]:.0f} s, most {cpu[-1]:.0f} s"
            )
    return "\n".join(lines)


def main() -> None:
    """Runs the tasks of the plan that have no row yet, or summarises."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON lines, one per run")
    parser.add_argument("--rigs", type=int, default=30, help="how many, kinds taking turns")
    parser.add_argument("--first", type=int, default=0, help="seed of the first rig of each kind")
    parser.add_argument("--seed", type=int, default=0, help="of the loop")
    parser.add_argument("--methods", default=f"{WITH},{WITHOUT}")
    parser.add_argument("--summary", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if not arguments.summary:
        plan = planned(arguments.first, arguments.rigs, arguments.methods.split(","))
        for kind, rig, method in plan:
            key = f"furuta-{kind}-{rig}", method, arguments.seed
            if key in {(r["rig"], r["method"], r["seed"]) for r in rows_of(arguments.out)}:
                continue
            row = row_of(kind, rig, method, arguments.seed)
            with arguments.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
                file.flush()
                os.fsync(file.fileno())
            found = row["iterations"][-1]["effects"] if row["iterations"] else []
            print(
                f"{row['seconds']:5.0f} s  {row['rig']:22} {method:20} {row['returns']} "
                f"{', '.join(found)}",
                flush=True,
            )
    print(summary(rows_of(arguments.out)))


if __name__ == "__main__":
    main()
