"""What a GPU saves: training, equations in torch and MuJoCo's engine MJX, each beside the CPU.

    python benchmarks/gpu.py --out gpu.json
    python benchmarks/gpu.py --parts ode --sizes 1000,100000
    python benchmarks/gpu.py --parts training --simulations 10000 --epochs 2

* ``training``: SNPE-C on the public task slcp, which has five parameters and eight features.
* ``ode``: the zoo's Furuta pendulum replays 100 commands, all measurements recorded. The results
  stay where they were computed.
* ``mjx``: an arm of six joints behind position servos replays 100 commands of 2 ms in
  ``MujocoSimulator`` and in MJX (``pip install mujoco-mjx``, with a JAX for the GPU). Times of MJX
  include the transfers to the GPU and back. A second case adds dry friction to the joints, which
  needs the engine's constraint solver. This case and double precision are measured at the largest
  size only, because MJX compiles anew for every case, size and precision.

Both sides run in the same process, the CPU on as many threads as cores. Times are by wall clock:
the first call, which compiles, apart, and then the median over calls of at least a second in all.
Without a GPU only the rows of the CPU are measured. With ``--out`` the file is written after every
row.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from gpu_mjx import mjx_rows
from gpu_rows import NUM_STEPS, Row, largest_difference, moment_difference, speed_up, timed
from methods import standard_normal_problem
from tasks import TASKS
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.inference.base import Backend
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.randomness import seeded

NUM_DRAWS = 20_000
"""Posterior draws whose moments are compared: their standard error is 0.007 standard deviations.
"""

LARGE_BATCH = 4096
"""Rows of a mini-batch in a second training, because small networks need large batches to occupy a
GPU. The default has 256."""

MOST_REPEATED = 10_000
"""Greatest number of simulations with which a second training is made, from another seed. It shows
by how much two trainings differ anyway."""

WARM_UP = 200
"""Simulations of a first training, which loads kernels and starts CUDA."""


def devices() -> tuple[str, ...]:
    """Returns the devices that torch can use here."""
    return ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)


def training_rows(sizes: list[int], epochs: int | None) -> Iterator[Row]:
    """SNPE-C with its defaults, and with large mini-batches; a second seed shows the spread."""
    limits = {} if epochs is None else {"epochs": epochs}
    large = {"batch_size": LARGE_BATCH}
    for case, options in (("snpe-c", {}), (f"batches of {LARGE_BATCH}", large)):
        method = backend("snpe-c", **options, **limits)
        for device in devices():
            trained(method, device, WARM_UP)
        for size in sizes:
            reference, seconds = trained(method, "cpu", size)
            yield Row("training", case, size, "cpu", seconds)
            for device in devices()[1:]:
                draws, seconds = trained(method, device, size)
                difference = moment_difference(reference, draws)
                yield Row("training", case, size, device, seconds, difference=difference)
            if size <= MOST_REPEATED:
                draws, seconds = trained(method, "cpu", size, seed=1)
                yield Row(
                    "training", case, size, "cpu, other seed of the training", seconds,
                    difference=moment_difference(reference, draws),
                )  # fmt: skip


def trained(
    method: Backend, device: str, num_simulations: int, seed: int = 0
) -> tuple[Tensor, float]:
    """Trains on simulations of slcp; returns draws of the posterior and seconds of the training.

    Args:
        method: The backend.
        device: Where to train.
        num_simulations: Number of simulations, which are the same for every seed.
        seed: Seed of the training.
    """
    task = TASKS["slcp"]
    with seeded(0, "simulations"):
        observed = task.simulate(task.to_theta(torch.zeros(1, task.num_parameters)))[0]
        z = torch.randn(num_simulations, task.num_parameters)
        x = task.simulate(task.to_theta(z))
    problem = standard_normal_problem(task, observed)
    problem = replace(problem, device=torch.device(device))
    with seeded(seed, "training"):
        start = time.perf_counter()
        state, _ = method.tell(problem, method.init(problem), z, x)
        seconds = time.perf_counter() - start
        draws = Mixture(method.densities(problem, state)).sample(NUM_DRAWS)
    return draws.cpu(), seconds


def ode_rows(sizes: list[int]) -> Iterator[Row]:
    """The Furuta pendulum in float32, in loops of torch and compiled."""
    for size in sizes:
        reference = None
        for device in devices():
            for mode in ("never", "always"):
                case = f"{device}, compiled" if mode == "always" else device
                run = furuta_replay(size, device, mode)
                try:
                    result, first, seconds = timed(run)
                except npdr.NpdrError as error:
                    yield Row("ode", "furuta", size, case, note=str(error).splitlines()[0])
                    continue
                reference = result.cpu() if reference is None else reference
                difference = largest_difference(reference, result)
                del result
                yield Row(
                    "ode", "furuta", size, case, seconds, first, size * NUM_STEPS, difference
                )


def furuta_replay(num_simulations: int, device: str, mode: Any) -> Callable[[], Tensor]:
    """Returns a function that simulates Furuta pendulums of different masses and lengths.

    Args:
        num_simulations: Number of simulations N.
        device: Where to simulate.
        mode: Whether to compile the loop.
    """
    simulator = Furuta(compile=mode)
    generator = torch.Generator().manual_seed(0)
    inputs = npdr.Inputs.single(
        4.0 * torch.sin(0.05 * torch.arange(float(NUM_STEPS)))[:, None],
        torch.tensor([0.1, 0.2, 0.0, 0.0]),
        action_names=("voltage",),
        state_names=tuple(state.name for state in simulator.states),
        time_step=simulator.time_step,
    ).to(device=device)
    parameters = {
        p.name: p.nominal * (0.8 + 0.4 * torch.rand(num_simulations, generator=generator))
        for p in simulator.parameters
    }
    parameters = {name: value.to(device) for name, value in parameters.items()}

    def run() -> Tensor:
        result = simulator.simulate(parameters, inputs)
        if device == "cuda":
            torch.cuda.synchronize()
        return result[:, 0]

    return run


HEADER = (
    f"{'part':9} {'case':16} {'size':>8} {'where':32} {'seconds':>9} {'first':>7} "
    f"{'M steps/s':>10} {'× cpu':>7} {'difference':>10}"
)


def describe(row: Row, rows: list[Row]) -> str:
    """Prints a row of the table."""

    def number(value: float | None, form: str) -> str:
        width = form.split(".")[0]
        return f"{'–':>{width}}" if value is None else f"{value:{form}}"

    rate = None
    if row.steps is not None and row.seconds is not None:
        rate = 1e-6 * row.steps / row.seconds
    return (
        f"{row.part:9} {row.case:16} {row.size:8} {row.where:32} {number(row.seconds, '9.3f')} "
        f"{number(row.first_seconds, '7.1f')} {number(rate, '10.3f')} "
        f"{number(speed_up(row, rows), '7.2f')} {number(row.difference, '10.1e')} {row.note}"
    ).rstrip()


def machine() -> dict[str, Any]:
    """Returns what the figures depend on."""
    names = [line for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    result: dict[str, Any] = {
        "cpu": names[0].split(":")[1].strip() if names else "unknown",
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
    return result


def _lines(path: str) -> list[str]:
    file = Path(path)
    return file.read_text().splitlines() if file.exists() else []


def numbers(text: str) -> list[int]:
    """Returns whole numbers between commas; ``1e5`` is one, too."""
    return [int(float(word)) for word in text.split(",")]


def main() -> None:
    """Measures the parts that the arguments choose."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default="training,ode,mjx")
    parser.add_argument("--simulations", type=numbers, default=numbers("1e4,1e5"), help="training")
    parser.add_argument("--epochs", type=int, help="of the training; default of the backend")
    parser.add_argument("--sizes", type=numbers, default=numbers("1e3,1e4,1e5,1e6"), help="of ode")
    parser.add_argument("--arms", type=numbers, default=[256, 4096, 32768], help="sizes of mjx")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of the CPU")
    parser.add_argument("--out", type=Path, help="JSON, written after every row")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    parts = {
        "training": lambda: training_rows(options.simulations, options.epochs),
        "ode": lambda: ode_rows(options.sizes),
        "mjx": lambda: mjx_rows(options.arms, options.threads),
    }
    chosen = [parts[name] for name in options.parts.split(",")]
    found = machine()
    print(f"{found['cpu']}, {found['threads']} threads; {found['gpu'] or 'no GPU: CPU only'}")
    print(HEADER)
    rows: list[Row] = []
    for part in chosen:
        for row in part():
            rows.append(row)
            print(describe(row, rows), flush=True)
            if options.out:
                lines = [asdict(r) | {"speed_up": speed_up(r, rows)} for r in rows]
                result = {"machine": found, "rows": lines}
                options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
