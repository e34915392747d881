"""What the adapters cost: steps per second through a simulator and through its engine's own loop.

    python benchmarks/engines.py                     # about a minute
    python benchmarks/engines.py --quick --json engines.json

Adapter and engine run the same simulations (parameters that vary over the batch, one recorded
segment of random commands) in turn within one process, on one thread, and agree on the readings
before they are timed. Rates are by wall clock; the cost is the median over repeats of the ratio of
processor times, less one, which other programs on the machine disturb least.
"""

import argparse
import importlib.util
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import workers

import npdr_ppl as npdr
from npdr_ppl.engines.bullet.client import connect
from npdr_ppl.engines.gymnasium import Attribute
from npdr_ppl.engines.pooled.pool_simulator import Segment
from npdr_ppl.models.effects import CoulombFriction
from npdr_ppl.models.pendulum import Pendulum

TARGET = 0.15
"""Greatest cost of an adapter that is acceptable, relative to the engine's own time."""

LEAST_SECONDS = 1.0
"""Rows that take milliseconds are repeated for so long."""

BULLET_BATCH = 32
"""Simulations of the engines that run one at a time."""

ODE_BATCH = 1 << 15
"""A batch in which arithmetic outweighs the calls to torch."""

FURUTA_XML = Path(__file__).parents[1] / "models" / "furuta.xml"


class Row(NamedTuple):
    """One row of the table; both functions return readings, ``(batch, steps, sensors)``."""

    engine: str
    case: str
    batch_size: int
    num_steps: int
    adapter: Callable[[], Any]
    own: Callable[[], Any]


class MujocoCase(NamedTuple):
    """An MJCF file with a mass and a damping that vary."""

    name: str
    path: Path
    body: str
    joint: str


def mujoco_cases() -> list[MujocoCase]:
    """Furuta's file, and some that Gymnasium ships where it is installed."""
    cases = [MujocoCase("furuta", FURUTA_XML, "pole", "pole")]
    found = importlib.util.find_spec("gymnasium")
    if found is not None and found.submodule_search_locations:
        folder = Path(found.submodule_search_locations[0]) / "envs" / "mujoco" / "assets"
        cases += [
            MujocoCase(
                "inverted double pendulum",
                folder / "inverted_double_pendulum.xml",
                "pole2",
                "hinge2",
            ),
            MujocoCase("hopper", folder / "hopper.xml", "foot", "foot_joint"),
            MujocoCase("half cheetah", folder / "half_cheetah.xml", "ffoot", "ffoot"),
        ]
    return cases


def mujoco_rows(batch_sizes: tuple[int, ...], num_steps: int) -> Iterator[Row]:
    """MujocoSimulator against mujoco.batch, parameters expanded and one native call each."""
    for case in mujoco_cases():
        for batch_size in batch_sizes:
            yield mujoco_row(case, batch_size, num_steps)
    yield friction_row(mujoco_cases()[0], batch_sizes[-1], num_steps)


def random_inputs(simulator: Any, num_steps: int) -> Any:
    """One segment of random commands from the file's pose."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(num_steps, len(simulator.actions), generator=generator).double()
    upper = torch.tensor([action.upper for action in simulator.actions], dtype=torch.float64)
    start = [
        0.0 if c.is_velocity else float(simulator.initial_positions[c.address])
        for c in simulator.components
    ]
    return npdr.Inputs.single(
        0.3 * upper * (2.0 * noise - 1.0),
        torch.tensor(start, dtype=torch.float64),
        action_names=tuple(action.name for action in simulator.actions),
        state_names=tuple(state.name for state in simulator.states),
        time_step=simulator.time_step,
    )


def mujoco_row(case: MujocoCase, batch_size: int, num_steps: int) -> Row:
    """A mass, whose derived constants follow, and a damping."""
    import mujoco
    from mujoco.batch import Batch

    simulator = npdr.MujocoSimulator(
        case.path,
        {"mass": f"body {case.body} mass", "damping": f"joint {case.joint} damping"},
        num_threads=1,
    )
    inputs = random_inputs(simulator, num_steps)
    nominal = simulator.nominal()
    factors = torch.linspace(0.8, 1.2, batch_size, dtype=torch.float64)
    parameters = {name: value * factors for name, value in nominal.items()}
    model = mujoco.MjModel.from_xml_path(str(case.path))
    body, joint = model.body(case.body).id, model.joint(case.joint).id
    dof = model.jnt_dofadr[joint]
    values = {name: value.numpy() for name, value in parameters.items()}
    control = inputs.actions[0].numpy()
    start = inputs.initial_values[0].numpy()
    spec = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)

    def own() -> np.ndarray:
        batch = Batch(model, batch_size, 1)
        batch.expand("body_mass")[:, body] = values["mass"]
        batch.expand("dof_damping")[:, dof] = values["damping"]
        batch.set_const()
        batch.bind("qpos")[:] = start[: model.nq]
        batch.bind("qvel")[:] = start[model.nq :]
        return batch.rollout(num_steps, control, record=(spec,))[spec]

    def adapter() -> np.ndarray:
        return simulator.simulate(parameters, inputs)[:, 0].numpy()

    return Row("mujoco", case.name, batch_size, num_steps, adapter, own)


def friction_row(case: MujocoCase, batch_size: int, num_steps: int) -> Row:
    """An effect at a joint, stepped from Python, against the same friction in the engine's loop.

    No target: an effect may depend on the state, so that every step returns to Python.
    """
    plain = npdr.MujocoSimulator(case.path, num_threads=1, states=None)
    port = next(port for port in plain.joints if port.startswith(case.joint))
    changed = plain.with_effects(CoulombFriction(port))
    inputs = random_inputs(plain, num_steps)
    rated = plain.port(port).rated
    magnitude = rated * torch.linspace(0.01, 0.05, batch_size, dtype=torch.float64)
    native = npdr.MujocoSimulator(
        hard_friction(case), {"friction": f"joint {case.joint} frictionloss"}, num_threads=1
    )

    def own() -> np.ndarray:
        return native.simulate({"friction": magnitude}, inputs)[:, 0].numpy()

    def adapter() -> np.ndarray:
        strength = {f"{port}.coulomb_friction.magnitude": magnitude}
        return changed.simulate(strength, inputs)[:, 0].numpy()

    return Row("mujoco", f"{case.name}, dry friction", batch_size, num_steps, adapter, own)


def hard_friction(case: MujocoCase) -> Any:
    """The file with the solver parameters that the effect uses."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(case.path))
    dof = model.jnt_dofadr[model.joint(case.joint).id]
    model.dof_solref[dof] = 2.0 * model.opt.timestep, 1.0
    model.dof_solimp[dof] = 0.9999, 0.9999, 0.001, 0.5, 2.0
    return model


def bullet_rows(batch_sizes: tuple[int, ...], num_steps: int) -> Iterator[Row]:
    """BulletSimulator against a loop by hand over PyBullet's functions, both in this process.

    What workers add is measured by ``benchmarks/workers.py``.
    """
    batch_size = min(BULLET_BATCH, batch_sizes[-1])
    yield bullet_row(batch_size, num_steps, 1)
    yield bullet_row(batch_size, num_steps, 4)


def bullet_row(batch_size: int, num_steps: int, substeps: int) -> Row:
    """A pendulum on a motor, its mass varied."""
    file = Path(tempfile.mkdtemp()) / "pendulum.urdf"
    file.write_text(workers.URDF)
    client, told = connect(), workers.segment(num_steps)
    simulator = workers.pendulum(file, substeps)
    masses = np.linspace(0.8, 1.2, batch_size).tolist()

    def own() -> np.ndarray:
        return np.stack(
            [workers.bare_loop(client, str(file), told, substeps, mass) for mass in masses]
        )

    def adapter() -> np.ndarray:
        parameters = [{**workers.PARAMETERS, "mass": mass} for mass in masses]
        return np.stack([simulator.simulate_one(client, p, told, 0) for p in parameters])

    case = f"pendulum, {substeps} substep{'s' * (substeps > 1)}"
    return Row("bullet", case, batch_size, num_steps, adapter, own)


def gymnasium_rows(batch_sizes: tuple[int, ...], num_steps: int) -> Iterator[Row]:
    """GymnasiumSimulator against a loop by hand over an environment, both in this process."""
    if importlib.util.find_spec("gymnasium") is None:
        return
    import gymnasium

    simulator = npdr.GymnasiumSimulator(
        "Pendulum-v1",
        parameters={"mass": Attribute("m", "kg")},
        states=(npdr.Channel("angle", "rad"), npdr.Channel("velocity", "rad/s", rate_of="angle")),
        set_state="state",
    )
    commands = np.sin(0.1 * np.arange(num_steps))[:, None].astype(np.float32)
    told = Segment(np.array([2.0, 0.0]), commands.astype(float), simulator.time_step, 0.0)
    masses = np.linspace(0.8, 1.2, min(BULLET_BATCH, batch_sizes[-1])).tolist()
    workspace = simulator.set_up()
    environment = gymnasium.make("Pendulum-v1", disable_env_checker=True)
    inner = environment.unwrapped

    def own() -> np.ndarray:
        result = np.empty((len(masses), num_steps, 2))
        for rows, mass in zip(result, masses, strict=True):
            inner.m = mass
            environment.reset(seed=0)
            inner.state = np.array([2.0, 0.0])
            for row, command in zip(rows, commands, strict=True):
                environment.step(command)
                row[:] = inner.state
        return result

    def adapter() -> np.ndarray:
        return np.stack([simulator.simulate_one(workspace, {"mass": m}, told, 0) for m in masses])

    yield Row("gymnasium", "pendulum", len(masses), num_steps, adapter, own)


def ode_rows(batch_sizes: tuple[int, ...], num_steps: int) -> Iterator[Row]:
    """ODESimulator, not compiled, against the same equations in a loop of torch by hand.

    ``benchmarks/simulation.py`` compares what compiling it brings.
    """
    for batch_size in (*batch_sizes, ODE_BATCH):
        yield ode_row(batch_size, num_steps)


def ode_row(batch_size: int, num_steps: int) -> Row:
    """The zoo's pendulum, mass and damping varied, semi-implicit Euler."""
    simulator = Pendulum(compile="never")
    step = simulator.time_step
    torque = 3.0 * torch.sin(0.1 * torch.arange(num_steps).double())
    inputs = npdr.Inputs.single(
        torque[:, None],
        torch.tensor([0.5, 0.0], dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=step,
    )
    factors = torch.linspace(0.8, 1.2, batch_size, dtype=torch.float64)
    parameters = {"mass": factors, "damping": 0.1 * factors}

    def own() -> np.ndarray:
        mass, damping = parameters["mass"], parameters["damping"]
        inverse, lever = 3.0 / mass, 1.5 * 9.81
        drag = damping * inverse
        angle, velocity = torch.full_like(mass, 0.5), torch.zeros_like(mass)
        rows = []
        for command in torque:
            rate = command * inverse - drag * velocity - lever * torch.sin(angle)
            velocity = velocity + step * rate
            angle = angle + step * velocity
            rows += [angle, velocity]
        return torch.stack(rows, dim=-1).reshape(batch_size, num_steps, 2).numpy()

    def adapter() -> np.ndarray:
        return simulator.simulate(parameters, inputs)[:, 0].numpy()

    return Row("ode", "pendulum", batch_size, num_steps, adapter, own)


def measure(row: Row, num_repeats: int) -> dict[str, Any]:
    """Returns steps per second of both and the adapter's relative cost.

    Raises:
        SystemExit: The two do not agree.
    """
    error = float(np.abs(np.asarray(row.adapter()) - np.asarray(row.own())).max())
    if not error < 1e-9:
        raise SystemExit(f"{row.engine} {row.case}: adapter and engine differ by {error:.1e}.")
    wall: dict[str, list[float]] = {"adapter": [], "own": []}
    ratios = []
    runs = {"adapter": row.adapter, "own": row.own}
    start = time.perf_counter()
    while len(ratios) < num_repeats or time.perf_counter() - start < LEAST_SECONDS:
        processor = {}
        # In turn, and each first every other time.
        for name in sorted(runs, reverse=bool(len(ratios) % 2)):
            before, cpu_before = time.perf_counter(), time.process_time()
            runs[name]()
            processor[name] = time.process_time() - cpu_before
            wall[name].append(time.perf_counter() - before)
        ratios.append(processor["adapter"] / processor["own"])
    work = row.batch_size * row.num_steps
    return {
        "adapter": work / statistics.median(wall["adapter"]),
        "own": work / statistics.median(wall["own"]),
        "cost": statistics.median(ratios) - 1.0,
        "repeats": len(ratios),
        "error": error,
    }


def main() -> None:
    """Measures all rows and prints them side by side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repeats")
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[1, 32, 256])
    parser.add_argument("--steps", type=int, default=200, help="steps per simulation")
    parser.add_argument("--repeats", type=int, default=9, help="repeats per row")
    parser.add_argument("--engines", default="mujoco,bullet,gymnasium,ode", help="Which rows.")
    parser.add_argument("--json", help="file to write the figures to")
    options = parser.parse_args()
    torch.set_num_threads(1)
    num_repeats = 3 if options.quick else options.repeats
    sizes = tuple(options.batch_sizes)
    tables = {
        "mujoco": mujoco_rows,
        "bullet": bullet_rows,
        "gymnasium": gymnasium_rows,
        "ode": ode_rows,
    }
    chosen = [tables[name] for name in options.engines.split(",")]
    results = []
    print(
        f"{'engine':11}{'case':28}{'batch':>6}{'own steps/s':>14}{'adapter steps/s':>17}"
        f"{'cost':>8}"
    )
    for rows in chosen:
        for row in rows(sizes, options.steps):
            found = measure(row, num_repeats)
            results.append({"engine": row.engine, "case": row.case, "batch": row.batch_size})
            results[-1] |= found
            print(
                f"{row.engine:11}{row.case:28}{row.batch_size:6}{found['own']:14,.0f}"
                f"{found['adapter']:17,.0f}{100.0 * found['cost']:7.1f}%",
                flush=True,
            )
    print(f"Target: at most {100.0 * TARGET:.0f} % where the engine runs all steps on its own.")
    if options.json:
        with open(options.json, "w") as file:
            json.dump(results, file, indent=2)


if __name__ == "__main__":
    main()
