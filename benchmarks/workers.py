"""What workers and the Bullet adapter cost, against plain loops in the same run.

    python benchmarks/workers.py                      # about a minute
    python benchmarks/workers.py --executors loky,dask,ray --draws 4000
    python benchmarks/workers.py --strikes strike_100hz_8s.csv     # and mini golf, five minutes

Three tables:

* ``pool``: throughput of a pool of two workers against two plain processes that each run half of
  the draws in a loop, started at the same moment; with 100 % the pool costs nothing. Draws are a
  pendulum in Bullet of so many steps, and a NumPy loop of so many milliseconds.
* ``strikes``: the same for 4000 strikes of mini golf along recorded joints, parameters from the
  prior, and the seconds that they take.
* ``adapter``: milliseconds of :class:`BulletSimulator` per simulation against a loop over
  PyBullet's own functions that does the same.

Figures are medians over repetitions that alternate between the two sides, so that other programs
disturb both alike. The exit code is 1 if the pool's efficiency is below ``--least``.
"""

import argparse
import json
import math
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from npdr_ppl.engines.bullet import BulletSettings, BulletSimulator, Command, Sensor
from npdr_ppl.engines.bullet.client import connect
from npdr_ppl.engines.pooled.pool_simulator import Segment
from npdr_ppl.engines.workers import Draw, Pool, Task, WorkerOptions
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.prior import Prior
from npdr_ppl.models.mini_golf import MiniGolf, mini_golf
from npdr_ppl.rollouts import Rollouts

URDF = """<?xml version="1.0"?>
<robot name="pendulum">
  <link name="base">
    <inertial>
      <mass value="1.0"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 -0.5"/>
      <mass value="1.0"/>
      <inertia ixx="0.0833" iyy="0.0833" izz="1e-6" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/>
    <child link="rod"/>
    <axis xyz="0 -1 0"/>
  </joint>
</robot>
"""

NUM_STRIKES = 4_000

PARAMETERS = {"mass": 1.2, "damping": 0.1}


def pendulum(file: Path, substeps: int) -> BulletSimulator:
    """A rod on a motor, read at every step."""
    return BulletSimulator(
        file,
        parameters={"mass": "link rod mass", "damping": "joint hinge damping"},
        actions=(Command(Channel("torque", "N m", -4.5, 4.5), "joint hinge torque"),),
        sensors=(
            Sensor(Channel("angle", "rad"), "joint hinge position"),
            Sensor(Channel("velocity", "rad/s", rate_of="angle"), "joint hinge velocity"),
        ),
        settings=BulletSettings(time_step=0.02, substeps=substeps),
    )


def segment(num_steps: int) -> Segment:
    """A sine of torque from rest."""
    torque = 4.5 * np.sin(2 * math.pi * 0.02 * np.arange(num_steps))
    return Segment(np.zeros(2), torque[:, None], 0.02, 0.0)


def bare_loop(
    client: Any, file: str, told: Segment, substeps: int, mass: float = PARAMETERS["mass"]
) -> np.ndarray:
    """The same simulation as one would write it by hand."""
    client.resetSimulation()
    client.setTimeStep(told.time_step / substeps)
    client.setGravity(0.0, 0.0, -9.81)
    body = client.loadURDF(file, useFixedBase=True, flags=client.URDF_USE_INERTIA_FROM_FILE)
    client.setJointMotorControl2(body, 0, client.VELOCITY_CONTROL, force=0.0)
    for link in (-1, 0):
        client.changeDynamics(body, link, linearDamping=0.0, angularDamping=0.0)
    moments = [0.0833 * mass, 0.0833 * mass, 1e-6 * mass]
    client.changeDynamics(body, 0, mass=mass, jointDamping=PARAMETERS["damping"])
    client.changeDynamics(body, 0, localInertiaDiagonal=moments)
    client.resetJointState(body, 0, 0.0, 0.0)
    control, step, state = (
        client.setJointMotorControl2,
        client.stepSimulation,
        client.getJointState,
    )
    torque_control = client.TORQUE_CONTROL
    readings = np.empty((len(told.actions), 2))
    for k, (torque,) in enumerate(told.actions.tolist()):
        for _ in range(substeps):
            control(body, 0, torque_control, force=torque)
            step()
        readings[k] = state(body, 0)[:2]
    return readings


@dataclass(frozen=True)
class Swing(Task):
    """One simulation of the pendulum per draw."""

    simulator: BulletSimulator
    num_steps: int

    def set_up(self) -> Any:
        """Connects."""
        return self.simulator.set_up()

    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Simulates."""
        parameters = {**PARAMETERS, "mass": 0.5 + 0.001 * (draw.index % 1000)}
        return self.simulator.simulate_one(workspace, parameters, segment(self.num_steps), 0)


@dataclass(frozen=True)
class Compute(Task):
    """A fixed amount of arithmetic."""

    num_rounds: int

    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Iterates a map."""
        state = np.full((800, 2), 0.5)
        for _ in range(self.num_rounds):
            state = 3.9 * state * (1.0 - state)
        return state


class Golf(Task):
    """One strike of mini golf per draw, parameters from the prior.

    Args:
        file: Recorded strikes; the first one's joints are replayed.
        num_strikes: Parameter sets to draw.
    """

    def __init__(self, file: Path, num_strikes: int) -> None:
        inputs = Rollouts.load(file)[[0]].inputs()
        prior = Prior(mini_golf, (inputs,))
        torch.manual_seed(0)
        drawn = prior.to_parameters(prior.sample(num_strikes).double())
        self.simulator = MiniGolf()
        self.parameters = self.simulator.complete(drawn, torch.float64, torch.device("cpu"))
        self.segment = Segment(
            inputs.initial_values[0].double().numpy(),
            inputs.actions[0].double().numpy(),
            inputs.time_step,
            0.0,
        )

    def set_up(self) -> Any:
        """Connects."""
        return self.simulator.set_up()

    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Strikes."""
        parameters = {
            name: float(value[draw.index] if value.ndim else value)
            for name, value in self.parameters.items()
        }
        return self.simulator.simulate_one(workspace, parameters, self.segment, 0)


def plain_seconds(task: Task, num_draws: int, num_processes: int) -> float:
    """Returns the seconds that plain loops in processes of their own take, without set-up."""
    context = multiprocessing.get_context("fork")
    barrier, times = context.Barrier(num_processes), context.SimpleQueue()

    def loop(first: int) -> None:
        os.setsid()  # as workers do: some kernels share out processors by session
        workspace = task.set_up()
        task.run(workspace, Draw(0, None, 0))
        barrier.wait()
        started = time.perf_counter()
        for index in range(first, num_draws, num_processes):
            task.run(workspace, Draw(index, None, 0))
        times.put((started, time.perf_counter()))

    processes = [context.Process(target=loop, args=(i,)) for i in range(num_processes)]
    for process in processes:
        process.start()
    spans = [times.get() for _ in processes]
    for process in processes:
        process.join()
    return max(end for _, end in spans) - min(start for start, _ in spans)


def timed(function: Callable[[], Any]) -> float:
    """Returns the seconds that a call takes."""
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def pool_row(
    executor: str, task: Task, num_draws: int, num_workers: int, repeats: int
) -> dict[str, float]:
    """Returns throughputs of the pool and of plain processes, and their ratio."""
    ours, plain = [], []
    with Pool(WorkerOptions(executor, num_workers)) as pool:  # pyright: ignore[reportArgumentType]
        pool.run(task, [None] * 4 * num_workers)  # starts what a run of thousands starts once
        for _ in range(repeats):
            plain.append(plain_seconds(task, num_draws, num_workers))
            ours.append(timed(lambda: pool.run(task, [None] * num_draws)))
    ratios = [p / o for p, o in zip(plain, ours, strict=True)]
    return {
        "draw_ms": 1e3 * statistics.median(plain) * num_workers / num_draws,
        "pool_seconds": statistics.median(ours),
        "pool_draws_per_s": num_draws / statistics.median(ours),
        "plain_draws_per_s": num_draws / statistics.median(plain),
        "efficiency": statistics.median(ratios),
        "efficiency_min": min(ratios),
        "efficiency_max": max(ratios),
    }


def adapter_row(file: Path, num_steps: int, substeps: int, repeats: int) -> dict[str, float]:
    """Returns milliseconds per simulation of the adapter and of a loop by hand."""
    client = connect()
    simulator = pendulum(file, substeps)
    told = segment(num_steps)
    found = simulator.simulate_one(client, PARAMETERS, told, 0)
    expected = bare_loop(client, str(file), told, substeps)
    assert np.abs(found - expected).max() < 1e-6, "the two loops simulate different things"
    ours, bare = [], []
    for _ in range(repeats):
        ours.append(timed(lambda: simulator.simulate_one(client, PARAMETERS, told, 0)))
        bare.append(timed(lambda: bare_loop(client, str(file), told, substeps)))
    client.disconnect()
    return {
        "adapter_ms": 1e3 * statistics.median(ours),
        "bare_ms": 1e3 * statistics.median(bare),
        "ratio": statistics.median(ours) / statistics.median(bare),
    }


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--executors", default="loky", help="With commas in between.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--draws", type=int, default=600)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--strikes", type=Path, help="Recorded strikes, for mini golf.")
    parser.add_argument("--least", type=float, default=0.0, help="Least efficiency, e.g. 0.85.")
    parser.add_argument("--out", type=Path, help="JSON file to write.")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, Any] = {"pool": {}, "adapter": {}}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pendulum.urdf"
        file.write_text(URDF)
        for num_steps, substeps in ((200, 1), (200, 4), (800, 1)):
            row = adapter_row(file, num_steps, substeps, 40)
            result["adapter"][f"{num_steps} steps × {substeps}"] = row
            print(
                f"adapter {num_steps} steps × {substeps}: {row['adapter_ms']:.2f} ms, by hand "
                f"{row['bare_ms']:.2f} ms, ratio {row['ratio']:.2f}"
            )
        tasks = {
            "bullet 400 steps": Swing(pendulum(file, 1), 400),
            "arithmetic": Compute(2_000),
        }
        for executor in options.executors.split(","):
            for name, task in tasks.items():
                row = pool_row(executor, task, options.draws, options.workers, options.repeats)
                result["pool"][f"{executor}, {name}"] = row
                print(
                    f"pool {executor}, {name} ({row['draw_ms']:.1f} ms): "
                    f"{row['pool_draws_per_s']:.0f} of {row['plain_draws_per_s']:.0f} draws/s, "
                    f"efficiency {row['efficiency']:.1%} "
                    f"({row['efficiency_min']:.1%} to {row['efficiency_max']:.1%})"
                )
        if options.strikes is not None:
            task = Golf(options.strikes, NUM_STRIKES)
            row = pool_row("loky", task, NUM_STRIKES, options.workers, 3)
            result["strikes"] = row
            print(
                f"pool loky, {NUM_STRIKES} strikes ({row['draw_ms']:.1f} ms): "
                f"{row['pool_seconds']:.1f} s, efficiency {row['efficiency']:.1%} "
                f"({row['efficiency_min']:.1%} to {row['efficiency_max']:.1%})"
            )
    if options.out is not None:
        options.out.write_text(json.dumps(result, indent=2) + "\n")
    rows = [*result["pool"].values(), *([result["strikes"]] if "strikes" in result else [])]
    if min(row["efficiency"] for row in rows) < options.least:
        raise SystemExit("The pool is less efficient than it should be.")


if __name__ == "__main__":
    main()
