"""Counts failures of a backend over seeds on the four public tasks, sequentially.

    python benchmarks/reliability.py --method snpe-a --seeds 50 --rounds 3 --simulations 3000

A fit fails if it raises, or if its posterior's draws or their density are not finite.
"""

import argparse
import time
from pathlib import Path

import torch
from methods import standard_normal_problem
from tasks import DATA, TASKS, load_reference

from npdr_ppl.errors import NpdrError
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend


def fails(name: str, task_name: str, rounds: int, simulations: int, seed: int, data: Path) -> str:
    """Fits once and returns why it failed, or an empty string."""
    task = TASKS[task_name]
    observation = load_reference(task_name, 1 + seed % 3, data).observation
    method = backend(name)
    problem = standard_normal_problem(task, observation)
    torch.manual_seed(seed)
    try:
        state = method.init(problem)
        for _ in range(rounds):
            z = method.ask(problem, state, simulations // rounds)
            state, _ = method.tell(problem, state, z, task.simulate(task.to_theta(z)))
        posterior = Mixture(method.densities(problem, state))
        draws = posterior.sample(1000)
        finite = draws.isfinite().all() and posterior.log_prob(draws).isfinite().all()
    except (NpdrError, RuntimeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return "" if finite else "draws or their density are not finite"


def main() -> None:
    """Runs the fits that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="snpe-a")
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--simulations", type=int, default=3_000, help="in all rounds together")
    parser.add_argument("--data", type=Path, default=DATA)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for task in arguments.tasks.split(","):
        start = time.process_time()
        reasons = [
            fails(
                arguments.method,
                task,
                arguments.rounds,
                arguments.simulations,
                seed,
                arguments.data,
            )
            for seed in range(arguments.seeds)
        ]
        failed = [reason for reason in reasons if reason]
        print(
            f"{task:17} {len(failed)} of {arguments.seeds} failed, "
            f"{time.process_time() - start:.0f} s of CPU",
            *sorted(set(failed)),
            sep="\n  ",
            flush=True,
        )


if __name__ == "__main__":
    main()
