"""Compares this package's backends with sbi's methods on public tasks, on one thread.

    python benchmarks/inference.py --out single.json
    python benchmarks/inference.py --methods ours:snpe-c,sbi:npe-c --tasks slcp \
        --observations 1 --rounds 5 --out sequential.json
    python benchmarks/inference.py --methods ours:snpe-a --rounds 3 --seeds 50 --out seeds.json
    python benchmarks/inference.py --methods ours:snpe-c,sbi:npe-c --observations test \
        --samples 2000 --out test.json

Observations 1 to 3 are the public ones, with their reference posteriors. ``tune`` and ``test`` are
twenty more each, drawn from the prior predictive distribution and sampled exactly; options were
chosen with the first and are reported with the second.

All get the same number of simulations and their own defaults. With one round a fit serves all
observations; with several there is a fit per observation. Seconds of the fit, simulations
included, and those of drawing the samples are kept apart, by the wall and by the process's CPU;
ratios use the latter, which depends less on what else the machine does. A fit that fails is a
row with its message.

With ``--out`` every row is written as soon as it is there, and a run given again continues.
"""

import argparse
import json
import logging
import os
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from exact_posteriors import OBSERVATION_SETS, make_reference
from methods import PEERS, Sampler, default_methods, find_method
from tasks import DATA, TASKS, Reference, load_reference

from npdr_ppl.metrics import c2st

NUM_PUBLIC = 3
"""Observations with public reference posteriors, numbered from 1."""


def find_reference(task: str, number: int, data: Path) -> Reference:
    """Returns a public observation's reference posterior, or makes an exact one."""
    if number <= NUM_PUBLIC:
        return load_reference(task, number, data)
    return make_reference(task, number)


def find_observations(text: str) -> list[int]:
    """Returns the observations' numbers: those of a set, or numbers between commas."""
    if text in OBSERVATION_SETS:
        return list(OBSERVATION_SETS[text])
    return [int(k) for k in text.split(",")]


@dataclass(frozen=True)
class Key:
    """What identifies a row."""

    method: str
    task: str
    observation: int
    rounds: int
    simulations: int
    seed: int


@dataclass(frozen=True)
class Row(Key):
    """A fit of one observation and its score; what a failure kept from being measured is null.

    Attributes:
        fit_wall: Seconds of the whole fit, simulations included.
        fit_cpu: The same by the process's CPU.
        sample_wall: Seconds of drawing the samples.
        sample_cpu: The same by the process's CPU.
        c2st: Score against the reference posterior; 0.5 is perfect.
        error: Why the fit failed, or ``None``.
    """

    fit_wall: float | None = None
    fit_cpu: float | None = None
    sample_wall: float | None = None
    sample_cpu: float | None = None
    c2st: float | None = None
    error: str | None = None

    @property
    def key(self) -> Key:
        """What identifies the row."""
        return Key(
            self.method, self.task, self.observation, self.rounds, self.simulations, self.seed
        )

    @property
    def total_cpu(self) -> float | None:
        """CPU seconds of fit and samples."""
        if self.fit_cpu is None or self.sample_cpu is None:
            return None
        return self.fit_cpu + self.sample_cpu


class Results:
    """Rows measured so far, kept in a file if there is one.

    Args:
        path: The file, or ``None``. Rows that it already holds are kept.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.rows: dict[Key, Row] = {}
        if path is not None and path.exists():
            for values in json.loads(path.read_text())["rows"]:
                row = Row(**values)
                self.rows[row.key] = row

    def add(self, row: Row) -> None:
        """Adds a row, prints it and writes the file."""
        self.rows[row.key] = row
        print(describe(row), flush=True)
        if self._path is None:
            return
        result = {
            "rows": [asdict(row) for row in self.rows.values()],
            "comparison": compare(self.rows),
            "failures": sum(row.error is not None for row in self.rows.values()),
        }
        part = self._path.with_suffix(".part")
        part.write_text(json.dumps(result, indent=1) + "\n")
        os.replace(part, self._path)


class Clock:
    """Seconds since it was made, by the wall and by the process's CPU."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Returns both."""
        return time.perf_counter() - self._wall, time.process_time() - self._cpu


def warm_up() -> None:
    """Makes a step of an optimiser: the first one loads a large part of torch, for everybody."""
    weight = torch.nn.Parameter(torch.ones(1))
    optimizer = torch.optim.AdamW([weight])
    weight.square().sum().backward()
    optimizer.step()


def seed_all(seed: int) -> None:
    """Seeds torch and NumPy, from which sbi's slice sampler draws."""
    torch.manual_seed(seed)
    np.random.seed(seed)


def measure(keys: list[Key], data: Path, num_samples: int, results: Results) -> None:
    """Fits one method with one seed to one task and adds a row for every observation.

    Args:
        keys: Rows to measure; they differ in the observation only.
        data: Folder of the reference posteriors.
        num_samples: Draws that are compared with as many of the reference posterior's.
        results: Where rows go.
    """
    sample: Sampler | None = None
    error, wall, cpu = None, 0.0, 0.0
    for key in keys:
        task = TASKS[key.task]
        reference = find_reference(task.name, key.observation, data)
        if (sample is None and error is None) or key.rounds > 1:
            seed_all(key.seed)
            clock = Clock()
            sample, error = None, None
            try:
                fit = find_method(key.method)
                sample = fit(task, reference.observation, key.rounds, key.simulations)
            except Exception as failure:  # whatever a peer raises is a result
                error = f"{type(failure).__name__}: {failure}"
            wall, cpu = clock.read()
        if sample is None:
            results.add(Row(**asdict(key), fit_wall=wall, fit_cpu=cpu, error=error))
            continue
        seed_all(key.seed + 1)
        clock = Clock()
        try:
            draws = sample(reference.observation, num_samples)
            seconds = clock.read()
            score = c2st(draws, reference.samples)
        except Exception as failure:
            sentence = f"{type(failure).__name__}: {failure}"
            results.add(Row(**asdict(key), fit_wall=wall, fit_cpu=cpu, error=sentence))
            continue
        results.add(Row(**asdict(key), fit_wall=wall, fit_cpu=cpu, sample_wall=seconds[0],
                        sample_cpu=seconds[1], c2st=score))  # fmt: skip


def compare(rows: dict[Key, Row]) -> list[dict[str, float | int | str | bool | None]]:
    """Compares each row of ours with its peers: speed-up, both scores, and which is lower."""
    lines = []
    for key, ours in rows.items():
        source, _, name = key.method.partition(":")
        for peer in PEERS.get(name, ()) if source == "ours" else ():
            theirs = rows.get(Key(**asdict(key) | {"method": f"sbi:{peer}"}))
            if theirs is None:
                continue
            is_scored = ours.c2st is not None and theirs.c2st is not None
            lines.append(
                asdict(key)
                | {
                    "peer": theirs.method,
                    "times_faster_fit": ratio(theirs.fit_cpu, ours.fit_cpu),
                    "times_faster_in_all": ratio(theirs.total_cpu, ours.total_cpu),
                    "c2st": ours.c2st,
                    "c2st_peer": theirs.c2st,
                    "is_lower_or_equal": ours.c2st <= theirs.c2st if is_scored else None,
                    "error": ours.error,
                    "error_peer": theirs.error,
                }
            )
    return lines


def ratio(theirs: float | None, ours: float | None) -> float | None:
    """Returns how many times longer theirs took."""
    return None if theirs is None or ours is None else theirs / ours


def number(value: float | None, width: int, digits: int) -> str:
    """Prints a figure, or a dash for one that is missing."""
    return f"{'–':>{width}}" if value is None else f"{value:{width}.{digits}f}"


HEADER = (
    f"{'method':14} {'task':17} {'obs':>3} {'rounds':>6} {'seed':>4} {'fit wall':>9} "
    f"{'fit cpu':>8} {'draw wall':>9} {'draw cpu':>8} {'C2ST':>7}"
)


def describe(row: Row) -> str:
    """Prints a row of the table."""
    return (
        f"{row.method:14} {row.task:17} {row.observation:3} {row.rounds:6} {row.seed:4} "
        f"{number(row.fit_wall, 9, 1)} {number(row.fit_cpu, 8, 1)} "
        f"{number(row.sample_wall, 9, 1)} {number(row.sample_cpu, 8, 1)} "
        f"{number(row.c2st, 7, 4)} {(row.error or '').splitlines()[0][:80] if row.error else ''}"
    ).rstrip()


def summarise(rows: dict[Key, Row]) -> str:
    """Prints the comparison and how many fits failed."""
    lines = [
        f"{'ours':14} {'peer':13} {'task':17} {'obs':>3} {'rounds':>6} {'seed':>4} "
        f"{'fit ×':>7} {'in all ×':>8} {'C2ST':>7} {'peer':>7}"
    ]
    for line in compare(rows):
        verdict = {True: "lower or equal", False: "higher", None: "failed"}
        lines.append(
            f"{line['method']:14} {line['peer']:13} {line['task']:17} {line['observation']:3} "
            f"{line['rounds']:6} {line['seed']:4} {number(line['times_faster_fit'], 7, 1)} "
            f"{number(line['times_faster_in_all'], 8, 1)} {number(line['c2st'], 7, 4)} "
            f"{number(line['c2st_peer'], 7, 4)} {verdict[line['is_lower_or_equal']]}"
        )
    lines += [describe_task(*names, rows) for names in dict.fromkeys(
        (key.method, key.task) for key in rows
    )]  # fmt: skip
    for method in dict.fromkeys(key.method for key in rows):
        own = [row for key, row in rows.items() if key.method == method]
        failed = sum(row.error is not None for row in own)
        lines.append(f"{method}: {failed} failures in {len(own)} rows")
    return "\n".join(lines)


def describe_task(method: str, task: str, rows: dict[Key, Row]) -> str:
    """Prints a method's mean and worst score and mean seconds of a fit over a task's rows."""
    own = [row for key, row in rows.items() if (key.method, key.task) == (method, task)]
    scores = [row.c2st for row in own if row.c2st is not None]
    seconds = [row.fit_cpu for row in own if row.fit_cpu is not None]
    mean = sum(scores) / len(scores) if scores else None
    worst = max(scores, default=None)
    fit = sum(seconds) / len(seconds) if seconds else None
    return (
        f"{method:14} {task:17} C2ST of {len(scores):3} rows: mean {number(mean, 6, 4)}, "
        f"worst {number(worst, 6, 4)}; fit {number(fit, 6, 1)} CPU s"
    )


def main() -> None:
    """Runs the comparison that the arguments choose."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", default=",".join(default_methods()))
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--observations", default="1,2,3", help="numbers, tune or test")
    parser.add_argument("--samples", type=int, default=10_000, help="draws that are compared")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--simulations", type=int, default=10_000, help="in all rounds together")
    parser.add_argument("--seeds", type=int, default=1, help="how many seeds, from 0")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path, help="JSON; rows that it holds are not measured again")
    arguments = parser.parse_args()
    observations = find_observations(arguments.observations)
    if min(observations) <= NUM_PUBLIC and not (arguments.data / "sbibm").is_dir():
        print(f"Skipped: there are no reference posteriors in {arguments.data / 'sbibm'}.")
        return
    methods = arguments.methods.split(",")
    for method in methods:
        find_method(method)  # a misspelt name stops here
    if any(method.startswith("sbi:") for method in methods):
        import sbi.inference  # noqa: F401 - so that no fit's seconds contain the import
    warm_up()
    torch.set_num_threads(1)
    logging.getLogger("sbi").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")  # sbi's, about its own dependencies
    results = Results(arguments.out)
    print(HEADER)
    for seed in range(arguments.seeds):
        for task in arguments.tasks.split(","):
            for method in methods:
                keys = [
                    Key(method, task, k, arguments.rounds, arguments.simulations, seed)
                    for k in observations
                ]
                missing = [key for key in keys if key not in results.rows]
                measure(missing, arguments.data, arguments.samples, results)
    print(summarise(results.rows))


if __name__ == "__main__":
    main()
