"""Discovery on whole arms behind position servos: effects named, time, memory.

    python benchmarks/servo_arms.py --part tune --out tune.jsonl
    test() { python benchmarks/servo_arms.py --part test --out test.jsonl "$@"; }
    test --num-seeds 15 --conditions one,two   # 60 cases of two arms
    test --num-seeds 10 --conditions none      # 20
    python benchmarks/servo_arms.py --summary test.jsonl

Two arms, of six and of seven joints, follow from public inertial values; see
:mod:`servo_arms_links`. A case hides one or two effects, or none, in a rig that is simulated by
another method in finer steps, with laws of its own and other values of armature and damping. It
records positions under three sets of commands, 10 s at 500 Hz each; the third is held out. The
model under test takes the user's file, in which the masses are the case's own, and has damping
and armature of each joint as parameters. With ``--masses fitted`` the file has the public masses,
and those of all links but the last are parameters, too.

Each case is searched by ``npdr.discover`` with all defaults in a process of its own. Rows are
written as they come, and a run given again continues. Tuning and reporting use other seeds. The
targets of time hold for two cores, so run one worker on two cores that nothing else uses.
"""

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

# The copy of the package beside this file is judged, wherever another is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch  # noqa: E402
from clean_fits_runs import run  # noqa: E402
from discovery_rows import effect_id  # noqa: E402
from servo_arms_cases import KINDS, Task, make_case  # noqa: E402
from servo_arms_links import ARMS  # noqa: E402
from servo_arms_rows import MEBIBYTE, judged, print_summary, told  # noqa: E402

from npdr_ppl.models.effects.registry import effects  # noqa: E402

KEYS = ("arm", "condition", "kinds", "separation", "masses", "seed")
"""What tells rows apart."""

SEEDS = {"tune": range(100), "test": range(1000, 1100)}
"""Seeds of both parts."""


def tasks(
    conditions: Sequence[str],
    arms: Sequence[str],
    kinds: Sequence[str],
    separations: Sequence[float],
    masses: str,
    seeds: Sequence[int],
) -> Iterator[Task]:
    """Returns all tasks, seed by seed so that a run stopped early is balanced.

    Kinds and separations of one effect are taken in turn, another one for each arm.
    """
    for seed in seeds:
        for condition in conditions:
            for number, arm in enumerate(arms):
                turn = seed + number * (len(kinds) // len(arms))
                chosen = {"none": (), "one": (kinds[turn % len(kinds)],), "two": tuple(kinds)}
                # All pairs of kind and separation come up.
                round_of_kinds = seed // len(kinds)
                wanted = separations[(seed + number + round_of_kinds) % len(separations)]
                if condition == "none":
                    wanted = 0.0
                yield Task(arm, condition, chosen[condition], wanted, masses, seed)


def judge(
    task: Task, folder: Path, *, threads: int, time_limit: float, keep: bool = False
) -> dict[str, Any]:
    """Makes a case, searches it in a process of its own, and returns the row.

    Args:
        task: The case.
        folder: Where cases go.
        threads: Threads of the search.
        time_limit: Seconds after which it is ended.
        keep: Whether the case's folder stays.
    """
    torch.set_num_threads(1)
    row: dict[str, Any] = asdict(task) | {"kinds": list(task.kinds), "threads": threads}
    here = folder / f"{task.arm}-{task.condition}-{task.separation:g}-{task.masses}-{task.seed}"
    shutil.rmtree(here, ignore_errors=True)
    try:
        case = make_case(task)
    except ValueError as error:
        return row | {"unmade": str(error)}
    case.write(here)
    known = effects()
    row |= {
        "joints": len(case.arm.links),
        "hidden": [asdict(effect) for effect in case.hidden],
        "separations": list(case.separations),
        "truth": list(case.truth),
        "alternatives": [list(names) for names in case.alternatives],
        "is_in_catalogue": all(effect_id(name) in known for name in case.truth),
    }
    script = Path(__file__).with_name("servo_arms_discover.py")
    variables = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NPDR_NUM_THREADS")
    command = ["env", *(f"{name}={threads}" for name in variables), sys.executable, str(script)]
    outcome = run([*command, str(here), "--seed", str(task.seed)], time_limit=time_limit)
    row |= {
        "message": outcome.message,
        "seconds": outcome.seconds,
        "cpu_seconds": outcome.cpu_seconds,
        "peak_mib": outcome.peak_bytes / MEBIBYTE,
    }
    if not outcome.message:
        row |= answer(here / "discovery" / "discovery.json")
    if not keep:
        shutil.rmtree(here, ignore_errors=True)
    return row | judged(row)


def answer(file: Path) -> dict[str, Any]:
    """Returns what a ``discovery.json`` says."""
    found = json.loads(file.read_text())
    return {
        "verdict": found["verdict"],
        "reason": found["reason"],
        "problems": found["data_problems"],
        "p_value": found["alarm"]["p_value"],
        "left_p_value": found["remainder"]["p_value"],
        "unexplained": found["remainder"]["unexplained"],
        "effects": found["effects"],
        "stages": found["seconds"],
    }


def _key(row: dict[str, Any]) -> str:
    return json.dumps([row[name] for name in KEYS])


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="Discovery on whole arms behind servos.")
    parser.add_argument("--part", choices=sorted(SEEDS), default="tune")
    parser.add_argument("--conditions", default="one,two,none")
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument("--kinds", default=",".join(KINDS), help="what may be hidden")
    parser.add_argument(
        "--separations",
        default="0,30",
        help="separation of each effect, in turn; 0 for the typical size of an arm, at least 10",
    )
    parser.add_argument("--masses", choices=("known", "fitted"), default="known")
    parser.add_argument("--num-seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2, help="threads of each search")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds for each search")
    parser.add_argument("--workers", type=int, default=1, help="searches at a time")
    parser.add_argument("--out", type=Path, default=Path("servo_arms.jsonl"))
    parser.add_argument("--folder", type=Path, help="where cases go; a temporary one if none")
    parser.add_argument("--keep", action="store_true", help="keep models and recordings there")
    parser.add_argument("--summary", type=Path, help="only summarise this file")
    arguments = parser.parse_args()
    if arguments.summary:
        print_summary(arguments.summary)
        return
    done = set()
    if arguments.out.exists():
        done = {_key(json.loads(line)) for line in arguments.out.read_text().splitlines()}
    first = arguments.first_seed
    every = tasks(
        arguments.conditions.split(","),
        arguments.arms.split(","),
        arguments.kinds.split(","),
        [float(d) for d in arguments.separations.split(",")],
        arguments.masses,
        list(SEEDS[arguments.part])[first : first + arguments.num_seeds],
    )
    wanted = [task for task in every if _key(asdict(task)) not in done]
    print(f"{len(wanted)} cases to judge, {len(done)} done", flush=True)
    with (
        tempfile.TemporaryDirectory() as temporary,
        arguments.out.open("a") as file,
        ProcessPoolExecutor(arguments.workers) as pool,
    ):
        folder = (arguments.folder or Path(temporary)).resolve()
        options = {
            "threads": arguments.threads,
            "time_limit": arguments.limit,
            "keep": arguments.keep,
        }
        for future in as_completed(pool.submit(judge, t, folder, **options) for t in wanted):
            row = future.result()
            file.write(json.dumps(row) + "\n")
            file.flush()
            print(told(row), flush=True)
    print_summary(arguments.out)


if __name__ == "__main__":
    main()
