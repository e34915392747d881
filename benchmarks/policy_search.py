"""What policy search on the Furuta pendulum costs: steps per second, iterations, compilation.

    python benchmarks/policy_search.py --out policy_search.json     # about four minutes
    python benchmarks/policy_search.py --quick                      # a smoke test

Everything runs on one thread and in one process, so that the ratios hold on a busy machine too:

* the library's compiled loop, policy and reward included, in float32;
* one environment at a time in NumPy, as reference implementations do, with one evaluation of the
  dynamics per step and with four;
* the same scalar loop compiled by numba, where numba is installed;
* iterations of PoWER: 51 candidates × 50 domains × 4 initial states × 2500 steps, without effects
  and with dry friction in both joints and low-passed velocities, with the kernel that a whole loop
  of policy search is given.

Compilation is timed apart, with an empty cache on disk and from the cache.
"""

import argparse
import importlib.util
import json
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from simulation import (
    TIME_STEP,
    NumpyPendulum,
    Variant,
    check,
    make_episodes,
    measure,
    numba_loop,
    numpy_loop,
    torch_loop,
)

from npdr_ppl.loop.control_task import control_task
from npdr_ppl.loop.domains import Domains
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.loop.policy_optimisation import optimise_policy
from npdr_ppl.models.effects import CoulombFriction, SensorLowPass
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.policies.search_registry import policy_search

DEFAULT = "constant-acceleration"
EFFECTS = (
    CoulombFriction("arm"),
    CoulombFriction("pole"),
    SensorLowPass("arm_velocity,pole_velocity"),
)
EFFECT_PARAMETERS = {
    "arm.coulomb_friction.magnitude": 1e-3,  # N m
    "pole.coulomb_friction.magnitude": 1e-4,  # N m
    "arm_velocity,pole_velocity.sensor_low_pass.time_constant": 0.005,  # s
}


class RungeKuttaPendulum(NumpyPendulum):
    """Evaluates the dynamics four times per step."""

    def advance(self, voltage: float) -> None:
        """Integrates over one step."""
        start, rates = self.state, []
        for share in (0.0, 0.5, 0.5, 1.0):
            self.state = start + share * TIME_STEP * rates[-1] if rates else start
            rates.append(np.concatenate((self.state[2:], self.accelerations(voltage))))
        first, second, third, fourth = rates
        self.state = start + TIME_STEP / 6.0 * (first + 2.0 * (second + third) + fourth)


class Target(NamedTuple):
    """A figure, and the bound that it is to keep."""

    name: str
    value: float
    bound: float
    is_upper: bool = False

    @property
    def is_met(self) -> bool:
        """Whether the figure keeps its bound."""
        return bool(self.value <= self.bound if self.is_upper else self.value >= self.bound)


def compilation_start() -> float:
    """Returns the seconds until the compiler has done its very first kernel."""
    start = time.perf_counter()
    torch.compile(lambda x: x.sin() + 1.0)(torch.zeros(100))
    return time.perf_counter() - start


def compilation(variant: Variant) -> dict[str, float]:
    """Returns the seconds to compile a loop with an empty cache on disk, and from the cache."""
    seconds = {}
    for name in ("cold", "cached"):
        torch.compiler.reset()
        start = time.perf_counter()
        variant.run(variant.episodes, variant.num_steps)  # as long as what is timed: same kernel
        seconds[name] = time.perf_counter() - start
    return seconds


def power_iterations(with_effects: bool, num_repeats: int, num_domains: int) -> dict[str, float]:
    """Returns the median seconds of an iteration, and those of the first with compilation."""
    task = control_task("furuta-swing-up")
    simulator = Furuta(compile="always")
    generator = torch.Generator().manual_seed(0)
    parameters = {p.name: torch.full((num_domains,), p.nominal) for p in Furuta.parameters}
    if with_effects:
        simulator = simulator.with_effects(*EFFECTS)
        for name, value in EFFECT_PARAMETERS.items():
            parameters[name] = torch.full((num_domains,), value)
    search, loop = policy_search("power"), LoopOptions()
    wall, processor = [time.perf_counter()], [time.process_time()]

    def note(fraction: float, status: str) -> None:
        wall.append(time.perf_counter())
        processor.append(time.process_time())

    optimise_policy(
        task,
        Domains(simulator, parameters).spread(0.1, generator),
        search,
        task.policy.parameters,
        iterations=num_repeats + 1,
        num_initial_states=4,
        seed=0,
        expected_calls=loop.search_iterations * (loop.iterations + 1),
        progress=note,
    )
    return {
        "wall": statistics.median(np.diff(wall)[1:]),
        "cpu": statistics.median(np.diff(processor)[1:]),
        "first": wall[1] - wall[0],
    }


def throughput(quick: bool, num_repeats: int) -> tuple[dict, dict, dict]:
    """Returns compilation times, rates and errors of every variant, checked before it is timed."""
    scale = 5 if quick else 1
    small = make_episodes(1, 5, 2)
    iteration, large = make_episodes(51 // scale, 50, 4), make_episodes(250 // scale, 50, 4)
    loops = {name: torch_loop("always", integrator=name) for name in (DEFAULT, "rk4")}
    compiled = [
        Variant(f"compiled, {name}, batch {batch.size}", run, batch, 500, 1e-3, name)
        for name, run in loops.items()
        for batch in (iteration, large)
    ]
    scalar = [
        Variant("NumPy, one at a time", numpy_loop(), small, 500, 1e-6),
        Variant(
            "NumPy, one at a time, four evaluations",
            numpy_loop(RungeKuttaPendulum),
            small,
            500,
            1e-6,
            "rk4",
        ),
    ]
    if importlib.util.find_spec("numba") is not None:
        scalar.append(Variant("numba, scalar", numba_loop(True), iteration, 250, 1e-3))
    seconds = {variant.integrator: compilation(variant) for variant in compiled[::2]}
    variants = compiled + scalar
    errors = {variant.name: check(variant) for variant in variants}
    rates = {variant.name: measure(variant, num_repeats) for variant in variants}
    return seconds, rates, errors


def ratios(rates: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Returns each compiled loop's rate over each scalar one's, by processor time."""
    return {
        name: {
            other: rate["cpu"] / rates[other]["cpu"]
            for other in rates
            if not other.startswith("compiled")
        }
        for name, rate in rates.items()
        if name.startswith("compiled")
    }


def main() -> None:
    """Measures and prints everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="smaller batches, fewer repeats")
    parser.add_argument("--repeats", type=int, default=5, help="repeats per variant")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    options = parser.parse_args()
    repeats = 2 if options.quick else options.repeats
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as cache:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
        start = compilation_start()
        seconds, rates, errors = throughput(options.quick, repeats)
        iterations = {
            name: power_iterations(with_effects, repeats, 10 if options.quick else 50)
            for name, with_effects in (("without effects", False), ("with effects", True))
        }
    factors = ratios(rates)

    print(f"{'variant':46}{'M steps/s wall':>16}{'cpu':>10}{'error':>10}  × NumPy (1, 4), numba")
    for name, rate in rates.items():
        by = "  ".join(f"{factor:.0f}" for factor in factors.get(name, {}).values())
        wall, cpu = rate["wall"] / 1e6, rate["cpu"] / 1e6
        print(f"{name:46}{wall:16.3f}{cpu:10.3f}{errors[name]:10.1e}  {by}")
    print(f"\n{'PoWER iteration':46}{'s wall':>16}{'cpu':>10}{'first':>10}")
    for name, row in iterations.items():
        print(f"{name:46}{row['wall']:16.3f}{row['cpu']:10.3f}{row['first']:10.1f}")
    print(f"\n{'compilation, s':46}{'cold':>16}{'cached':>10}")
    print(f"{'the compiler itself, once per machine':46}{start:16.1f}")
    for name, row in seconds.items():
        print(f"{name:46}{row['cold']:16.1f}{row['cached']:10.1f}")

    first, *_ = factors
    targets = [
        Target("million steps per second and core", rates[first]["cpu"] / 1e6, 200.0),
        Target("times one environment in NumPy", factors[first]["NumPy, one at a time"], 4_000.0),
        *(
            Target(f"seconds per PoWER iteration {name}", row["cpu"], 0.3, is_upper=True)
            for name, row in iterations.items()
        ),
    ]
    print()
    for target in targets:
        sign, verdict = "≤" if target.is_upper else "≥", "met" if target.is_met else "missed"
        print(f"{target.name}: {target.value:.3g} {sign} {target.bound:g}? {verdict}")
    if options.out is not None:
        figures = {
            "rates": rates,
            "errors": errors,
            "ratios": factors,
            "power_iterations": iterations,
            "compilation": {"start": start, **seconds},
            "targets": [{**target._asdict(), "is_met": target.is_met} for target in targets],
        }
        options.out.write_text(json.dumps(figures, indent=2, default=float) + "\n")


if __name__ == "__main__":
    main()
