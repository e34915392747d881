"""Default fits of clean recordings: does a new user find the truth, and blame nothing?

    python benchmarks/clean_fits.py --part tune --num-seeds 3 --out tune.jsonl
    python benchmarks/clean_fits.py --part test --num-seeds 20 --out test.jsonl --workers 2
    python benchmarks/clean_fits.py --summary test.jsonl

Recordings come from equations, integrators and noise of their own (:mod:`hidden_rigs`), under
parameters drawn from each model's prior, and nothing is missing in the model. Each is fitted by
``npdr fit`` with defaults only, in a process of its own on one thread. Rows are written as they
come, and a run given again continues. Tuning and reporting use other seeds.
"""

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# The copy of the package beside this file is judged, wherever another is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch  # noqa: E402
from clean_fits_conditions import CONDITIONS, made, subjects_of, variants_of  # noqa: E402
from clean_fits_rows import discovery_figures, error_figures, fit_figures  # noqa: E402
from clean_fits_runs import npdr_command, run  # noqa: E402
from clean_fits_subjects import HOLDOUT, SUBJECTS, Recorded  # noqa: E402
from clean_fits_summary import print_summary  # noqa: E402

from npdr_ppl.errors import DataError  # noqa: E402

KEYS = ("subject", "condition", "variant", "seed")
"""What tells rows apart."""

SEEDS = {"tune": range(100), "test": range(1000, 1200)}
"""Seeds of both parts."""


@dataclass(frozen=True)
class Task:
    """One recording to be fitted.

    Attributes:
        subject: What is recorded.
        condition: What is special about it; see :mod:`clean_fits_conditions`.
        variant: The backend where the condition compares some.
        seed: Seed of truth, excitation and noise.
    """

    subject: str
    condition: str
    variant: str
    seed: int


def tasks(
    conditions: Sequence[str], subjects: Sequence[str], seeds: Sequence[int]
) -> Iterator[Task]:
    """Returns all tasks, seed by seed so that a run stopped early is balanced."""
    for seed in seeds:
        for condition in conditions:
            for subject in (name for name in subjects if name in subjects_of(condition)):
                for variant in variants_of(condition):
                    yield Task(subject, condition, variant, seed)


def judge(
    task: Task, folder: Path, *, discover: bool = False, keep: bool = False
) -> dict[str, Any]:
    """Records, fits with defaults, and returns the row.

    Args:
        task: What to do.
        folder: Where recordings and fits go.
        discover: Whether to look for missing effects, too.
        keep: Whether the fit's folder stays.
    """
    torch.set_num_threads(1)
    row: dict[str, Any] = asdict(task)
    words = (task.subject, task.condition, task.variant, str(task.seed))
    here = folder / "-".join(word for word in words if word)
    shutil.rmtree(here, ignore_errors=True)  # of a run that was interrupted: it would continue
    try:
        recording = made(task.subject, task.condition, task.seed)
    except DataError as error:
        return row | {"unmade": str(error)}
    recording.write(here)
    row |= recording.notes
    outcome = run(_command(task, recording, here))
    row |= asdict(outcome)
    if outcome.exit_code == 0:
        out = here / "fit"
        try:
            row |= fit_figures(out, recording.truth, recording.prior)
            if recording.rollouts is not None:
                holdout = recording.rollouts[[HOLDOUT]]
                row |= error_figures(recording.replayed_in, holdout, out, recording.truth)
        except Exception as error:  # what cannot be read is a row with its message
            row["error"] = f"{type(error).__name__}: {error}"[:300]
    if discover and not recording.is_recipe:
        word, found = recording.word(here), here / "discovery"
        spent = run(npdr_command("discover", word, here / "rec.csv", found, HOLDOUT))
        row["discovery"] = asdict(spent)
        if spent.exit_code == 0:
            row["discovery"] |= discovery_figures(found)
    if not keep:
        for name in ("fit", "discovery"):
            shutil.rmtree(here / name, ignore_errors=True)
    return row


def _command(task: Task, recording: Recorded, folder: Path) -> list[str]:
    """Returns the fit as a command; only a backend to be compared is an option."""
    out = folder / "fit"
    if recording.is_recipe:
        recipe = Path(__file__).with_name("clean_fits_recipe.py")
        return [sys.executable, str(recipe), recording.model, str(folder), str(out)]
    command = npdr_command("fit", recording.word(folder), folder / "rec.csv", out, HOLDOUT)
    return [*command, *(["--backend", task.variant] if task.variant else [])]


def told(row: dict[str, Any]) -> str:
    """Returns a row in a line."""
    where = " ".join(str(row[name]) for name in KEYS if row[name] != "")
    if "unmade" in row:
        return f"{where}: {row['unmade']}"
    took = f"{row['cpu_seconds']:.0f} s, {row['peak_bytes'] / 2**20:.0f} MiB"
    if row["exit_code"]:
        return f"{where}: failed with {row['exit_code']}: {row['message']} ({took})"
    if "error" in row:
        return f"{where}: cannot be read: {row['error']} ({took})"
    inside = [p["is_inside"] for p in row["parameters"].values()]
    ratio = f", error ratio {row['rmse_ratio']:.2f}" if "rmse_ratio" in row else ""
    return f"{where}: {row['decision']}, {sum(inside)} of {len(inside)} inside{ratio} ({took})"


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in KEYS)


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=sorted(SEEDS), default="tune")
    parser.add_argument("--conditions", default="clean", help=", ".join(CONDITIONS))
    parser.add_argument("--subjects", default=",".join(SUBJECTS))
    parser.add_argument("--num-seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("clean_fits.jsonl"))
    parser.add_argument("--folder", type=Path, help="where recordings go; a temporary one if none")
    parser.add_argument("--discover", action="store_true", help="run npdr discover, too")
    parser.add_argument("--keep", action="store_true", help="keep the fits beside the recordings")
    parser.add_argument("--summary", type=Path, help="only summarise this file")
    arguments = parser.parse_args()
    if arguments.summary:
        print_summary(arguments.summary)
        return
    done = set()
    if arguments.out.exists():
        done = {_key(json.loads(line)) for line in arguments.out.read_text().splitlines()}
    first = arguments.first_seed
    seeds = list(SEEDS[arguments.part])[first : first + arguments.num_seeds]
    conditions, subjects = arguments.conditions.split(","), arguments.subjects.split(",")
    wanted = [t for t in tasks(conditions, subjects, seeds) if _key(asdict(t)) not in done]
    print(f"{len(wanted)} fits to make, {len(done)} done", flush=True)
    with (
        tempfile.TemporaryDirectory() as temporary,
        arguments.out.open("a") as file,
        ProcessPoolExecutor(arguments.workers) as pool,
    ):
        folder = (arguments.folder or Path(temporary)).resolve()
        options = {"discover": arguments.discover, "keep": arguments.keep}
        judged = [pool.submit(judge, task, folder, **options) for task in wanted]
        for future in as_completed(judged):
            row = future.result()
            file.write(json.dumps(row) + "\n")
            file.flush()
            print(told(row), flush=True)
    print_summary(arguments.out)


if __name__ == "__main__":
    main()
