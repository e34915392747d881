"""Compares snpe-c with sbi's NPE-C on public tasks, in one run and on one thread.

    python benchmarks/inference.py --tasks two_moons,slcp --observations 1,2,3 --out result.json
    python benchmarks/inference.py --tasks slcp --observations 1 --rounds 5 --out sequential.json

Both get the same number of simulations, their own defaults and seed 0. Seconds are those of the
whole fit, simulations included, by the wall and by the process's CPU; the latter is what the
ratio uses, because it does not depend on what else the machine does.
"""

import argparse
import json
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tasks import DATA, TASKS, Task, load_reference
from torch import Tensor

from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.mixture import Mixture
from npdr_ppl.inference.registry import backend
from npdr_ppl.metrics import c2st

NUM_SAMPLES = 10_000

Sampler = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Row:
    """A fit of one observation and its score."""

    method: str
    task: str
    observation: int
    rounds: int
    wall_seconds: float
    cpu_seconds: float
    sample_seconds: float
    c2st: float


def standard_normal_problem(task: Task, observation: Tensor) -> Problem:
    """States a task in reference coordinates."""
    normal = torch.distributions.Normal(0.0, 1.0)
    d = task.num_parameters
    return Problem(
        num_parameters=d,
        observation=observation,
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: normal.log_prob(z).sum(-1),
    )


def fit_ours(task: Task, observation: Tensor, rounds: int, simulations: int) -> Sampler:
    """Fits snpe-c with its defaults; returns draws of theta given an observation's features."""
    method = backend("snpe-c")
    problem = standard_normal_problem(task, observation)
    state = method.init(problem)
    for _ in range(rounds):
        z = method.ask(problem, state, simulations // rounds)
        state, _ = method.tell(problem, state, z, task.simulate(task.to_theta(z)))

    def sample(x: Tensor) -> Tensor:
        posterior = Mixture(method.densities(standard_normal_problem(task, x), state))
        return task.to_theta(posterior.sample(NUM_SAMPLES))

    return sample


def fit_sbi(task: Task, observation: Tensor, rounds: int, simulations: int) -> Sampler:
    """Fits sbi's NPE-C with a neural spline flow and its defaults."""
    from sbi.inference import NPE_C
    from sbi.utils import BoxUniform

    bound = task.scale * torch.ones(task.num_parameters)
    if task.is_uniform:
        prior = BoxUniform(-bound, bound)
    else:
        prior = torch.distributions.MultivariateNormal(0 * bound, torch.diag(bound**2))
    method = NPE_C(prior, density_estimator="nsf", show_progress_bars=False)
    proposal = prior
    posterior = None
    for number in range(rounds):
        theta = proposal.sample((simulations // rounds,))
        method.append_simulations(
            theta, task.simulate(theta), proposal=None if number == 0 else proposal
        ).train()
        posterior = method.build_posterior()
        if number < rounds - 1:
            proposal = posterior.set_default_x(observation)
    assert posterior is not None
    return lambda x: posterior.sample((NUM_SAMPLES,), x=x, show_progress_bars=False)


METHODS = {"npdr_ppl snpe-c": fit_ours, "sbi NPE-C NSF": fit_sbi}


def run(
    method: str,
    task: Task,
    observations: list[int],
    rounds: int,
    simulations: int,
    data: Path,
    seed: int,
) -> list[Row]:
    """Fits and scores; with one round, one amortised fit serves all observations."""
    rows = []
    sample, wall, cpu = None, 0.0, 0.0
    for number in observations:
        reference = load_reference(task.name, number, data)
        if sample is None or rounds > 1:
            torch.manual_seed(seed)
            wall, cpu = time.perf_counter(), time.process_time()
            sample = METHODS[method](task, reference.observation, rounds, simulations)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        torch.manual_seed(seed + 1)
        start = time.process_time()
        draws = sample(reference.observation)
        seconds = time.process_time() - start
        score = c2st(draws, reference.samples)
        rows.append(Row(method, task.name, number, rounds, wall, cpu, seconds, score))
        print(
            f"{method:16} {task.name:17} {number:3} {rounds:6} {wall:8.1f} {cpu:8.1f} "
            f"{seconds:8.1f} {score:7.4f}",
            flush=True,
        )
    return rows


def compare(rows: list[Row]) -> list[dict[str, float | int | str]]:
    """Sets every fit of sbi beside ours: how many times faster, and both scores."""
    ours, theirs = (
        {(row.task, row.observation): row for row in rows if row.method == method}
        for method in METHODS
    )
    return [
        {
            "task": task,
            "observation": observation,
            "rounds": row.rounds,
            "times_faster": theirs[task, observation].cpu_seconds / row.cpu_seconds,
            "c2st": row.c2st,
            "c2st_sbi": theirs[task, observation].c2st,
        }
        for (task, observation), row in ours.items()
        if (task, observation) in theirs
    ]


def main() -> None:
    """Runs the comparison that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--observations", default="1,2,3")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--simulations", type=int, default=10_000, help="in all rounds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--methods", default="ours,sbi", help="ours, sbi or both")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if not (arguments.data / "sbibm").is_dir():
        print(f"Skipped: there are no reference posteriors in {arguments.data / 'sbibm'}.")
        return
    torch.set_num_threads(1)
    logging.getLogger("sbi").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")  # sbi's, about its own dependencies
    keys = dict(zip(("ours", "sbi"), METHODS, strict=True))
    print(
        f"{'method':16} {'task':17} {'obs':>3} {'rounds':>6} {'wall s':>8} {'cpu s':>8} "
        f"{'sample s':>8} {'C2ST':>7}"
    )
    rows: list[Row] = []
    for task in arguments.tasks.split(","):
        for method in arguments.methods.split(","):
            rows += run(
                keys[method],
                TASKS[task],
                [int(number) for number in arguments.observations.split(",")],
                arguments.rounds,
                arguments.simulations,
                arguments.data,
                arguments.seed,
            )
    comparison = compare(rows)
    for line in comparison:
        print(
            f"{line['task']:17} observation {line['observation']}: "
            f"{line['times_faster']:.1f} times faster, C2ST {line['c2st']:.4f} "
            f"against {line['c2st_sbi']:.4f}"
        )
    if arguments.out:
        result = {"rows": [asdict(row) for row in rows], "comparison": comparison}
        arguments.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
