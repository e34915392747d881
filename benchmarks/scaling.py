"""Measures seconds and peak memory of a fit from a thousand to a million simulations.

    python benchmarks/scaling.py --out scaling.json --figure scaling.pdf
    python benchmarks/scaling.py --problem pendulum --sizes 1000,10000,100000

Two problems: ``gaussian``, a nonlinear function of four parameters with ten noisy outputs, told to
the backend directly, and ``pendulum``, a second of the zoo's pendulum through ``npdr_ppl.infer``,
simulations included. Every size runs in a process of its own on one thread, whose peak resident
memory, that of the imported libraries included, is read at its end. The slope is that of log
seconds by log simulations. The exit code is 1 if a fit needs more than ``--limit`` GiB.

``--epochs`` trains fewer epochs than the default, to measure memory alone; rows say so.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

SIZES = (1_000, 10_000, 100_000, 1_000_000)

NUM_PARAMETERS, NUM_FEATURES = 4, 10

DURATION = 50
"""Steps of 20 ms of the pendulum's recording."""

NOISE = {"angle": 0.25, "velocity": 1.0}
"""Standard deviations of the pendulum's readings in rad and rad/s."""


def fit_gaussian(size: int, name: str, options: dict[str, Any]) -> dict[str, Any]:
    """Tells a backend simulations of x = V tanh(W z) + noise; returns the round's figures."""
    from npdr_ppl.inference.base import Problem
    from npdr_ppl.inference.registry import backend

    torch.manual_seed(0)
    inner = torch.randn(NUM_PARAMETERS, NUM_FEATURES) / math.sqrt(NUM_PARAMETERS)
    outer = torch.randn(NUM_FEATURES, NUM_FEATURES) / math.sqrt(NUM_FEATURES)
    normal = torch.distributions.Normal(0.0, 1.0)
    problem = Problem(
        num_parameters=NUM_PARAMETERS,
        observation=torch.zeros(NUM_FEATURES),
        sample_prior=lambda n: torch.randn(n, NUM_PARAMETERS),
        log_prior=lambda z: normal.log_prob(z).sum(-1),
    )
    method = backend(name, **options)
    state = method.init(problem)
    z = method.ask(problem, state, size)
    x = (z @ inner).tanh() @ outer + 0.1 * torch.randn(size, NUM_FEATURES)
    _, info = method.tell(problem, state, z, x)
    return dict(info.losses)


def fit_pendulum(size: int, name: str, options: dict[str, Any]) -> dict[str, Any]:
    """Fits the zoo's pendulum to a rollout of its own; returns the round's figures."""
    from functools import partial

    import npdr_ppl as npdr
    from npdr_ppl.inference.registry import backend
    from npdr_ppl.models.pendulum import pendulum
    from npdr_ppl.reproduction.pendulum_ridge import record

    posterior = npdr.infer(
        partial(pendulum, noise=NOISE),
        record(DURATION),
        backend=backend(name, **options),
        num_simulations=size,
        options=npdr.DataOptions(embedding="all~10", precision="float32"),
        progress=False,
    )
    return dict(posterior.provenance.infos[-1].losses)


PROBLEMS = {"gaussian": fit_gaussian, "pendulum": fit_pendulum}


def measure(problem: str, size: int, name: str, epochs: int | None) -> dict[str, Any]:
    """Fits once and returns seconds and peak memory of this process."""
    torch.set_num_threads(1)
    options = {} if epochs is None else {"epochs": epochs}
    wall, cpu = time.perf_counter(), time.process_time()
    figures = PROBLEMS[problem](size, name, options)
    seconds = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "problem": problem,
        "backend": name,
        "simulations": size,
        "epochs_limit": epochs,
        "epochs": figures.get("epochs"),
        "seconds": seconds,
        "peak_gib": peak / (2**30 if sys.platform == "darwin" else 2**20),
    }


def measure_apart(problem: str, size: int, name: str, epochs: int | None) -> dict[str, Any]:
    """Calls :func:`measure` in a process of its own.

    Raises:
        SystemExit: It failed.
    """
    command = [sys.executable, __file__, "--one", "--problem", problem, "--sizes", str(size)]
    command += ["--backend", name] + ([] if epochs is None else ["--epochs", str(epochs)])
    child = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if child.returncode:
        raise SystemExit(f"The fit of {size} simulations failed with {child.returncode}.")
    return json.loads(child.stdout.splitlines()[-1])


def slope(rows: list[dict[str, Any]]) -> float | None:
    """Returns the least-squares slope of log CPU seconds by log simulations, from two sizes on."""
    points = [(math.log(row["simulations"]), math.log(row["seconds"]["cpu"])) for row in rows]
    if len(points) < 2:
        return None
    x, y = torch.tensor(points, dtype=torch.float64).unbind(-1)
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x * x).sum())


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws seconds and memory by simulations."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3), layout="constrained")
    sizes = [row["simulations"] for row in rows]
    seconds, memory = figure.subplots(1, 2)
    seconds.loglog(sizes, [row["seconds"]["cpu"] for row in rows], marker="o")
    seconds.set(xlabel="simulations", ylabel="CPU seconds")
    memory.semilogx(sizes, [row["peak_gib"] for row in rows], marker="o")
    memory.set(xlabel="simulations", ylabel="peak memory, GiB", ylim=(0, None))
    figure.savefig(path)


def main() -> None:
    """Measures the sizes that the arguments choose."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problem", choices=PROBLEMS, default="gaussian")
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)))
    parser.add_argument("--backend", default="snpe-c")
    parser.add_argument("--epochs", type=int, help="epochs at most, instead of the default")
    parser.add_argument("--limit", type=float, default=8.0, help="GiB of memory allowed")
    parser.add_argument("--out", type=Path, help="JSON file")
    parser.add_argument("--figure", type=Path, help="PDF or PNG file")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    sizes = [int(size) for size in arguments.sizes.split(",")]
    if arguments.one:
        row = measure(arguments.problem, sizes[0], arguments.backend, arguments.epochs)
        print(json.dumps(row))
        return
    print(f"{'simulations':>11} {'epochs':>6} {'wall s':>8} {'cpu s':>8} {'peak GiB':>8}")
    rows: list[dict[str, Any]] = []
    for size in sizes:
        row = measure_apart(arguments.problem, size, arguments.backend, arguments.epochs)
        rows.append(row)
        print(
            f"{size:11} {row['epochs'] or '–':>6} {row['seconds']['wall']:8.1f} "
            f"{row['seconds']['cpu']:8.1f} {row['peak_gib']:8.2f}",
            flush=True,
        )
        if arguments.out:
            result = {"rows": rows, "slope": slope(rows)}
            arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    if (value := slope(rows)) is not None:
        print(f"Slope of log seconds by log simulations: {value:.2f}")
    if arguments.figure:
        draw(rows, arguments.figure)
    worst = max(row["peak_gib"] for row in rows)
    if worst > arguments.limit:
        raise SystemExit(f"A fit took {worst:.1f} GiB, more than {arguments.limit} GiB.")


if __name__ == "__main__":
    main()
