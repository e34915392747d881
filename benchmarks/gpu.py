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
import importlib
import importlib.util
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from methods import standard_normal_problem
from tasks import TASKS
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.inference.base import Backend
from npdr_ppl.inference.parts.mixtures.ensemble import Mixture
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.randomness import seeded

LEAST_SECONDS = 1.0
"""Calls are repeated until they have taken this many seconds in all. One that takes longer is
measured once."""

NUM_STEPS = 100
"""Steps of a replayed segment, as in a fit that re-synchronises the state every 0.2 s at 2 ms."""

NUM_SEGMENTS = 64
"""Segments of commands that the arm replays; the other simulations differ in their parameters."""

BLOCK = 100_000
"""Simulations whose results are compared at a time."""

DERIVED = ("dof_invweight0",)
"""Fields that the engine computes from the parameters and that dry friction depends on."""

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

CASES = "smooth", "dry friction"
"""Arms of the part ``mjx``."""


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        part: Part of the benchmark.
        case: What was computed.
        size: Number of simulations.
        where: Processor and engine.
        seconds: Seconds of a call, or ``None`` if it was not measured.
        first_seconds: Seconds of the first call, which includes compilation.
        steps: Simulated steps of a call; ``None`` for training.
        difference: Largest difference from the first row of the same case and size: in standard
            deviations of the posterior for training, otherwise in the sensors' units.
        note: What else there is to say, such as why there is no measurement.
    """

    part: str
    case: str
    size: int
    where: str
    seconds: float | None = None
    first_seconds: float | None = None
    steps: int | None = None
    difference: float | None = None
    note: str = ""


def speed_up(row: Row, rows: list[Row]) -> float | None:
    """Returns how many times faster a row is than the first of the same case and size."""
    key = row.part, row.case, row.size
    first = next(r for r in rows if (r.part, r.case, r.size) == key)
    if row.seconds is None or first.seconds is None:
        return None
    return first.seconds / row.seconds


def moment_difference(reference: Tensor, draws: Tensor) -> float:
    """Returns the largest difference of means and standard deviations, in standard deviations.

    Args:
        reference: Draws of one posterior, ``(n, d)``.
        draws: Draws of the other, ``(n, d)``.
    """
    scale = reference.std(0)
    means = (draws.mean(0) - reference.mean(0)).abs() / scale
    return float(torch.maximum(means, (draws.std(0) / scale - 1.0).abs()).max())


def largest_difference(reference: Any, other: Any) -> float:
    """Returns the largest difference of two arrays of equal shape; NaN if one of them has a NaN.

    Compares a block of simulations at a time, so that it needs little memory.
    """

    def block(values: Any, first: int) -> Tensor:
        return torch.as_tensor(values[first : first + BLOCK]).double().cpu()

    firsts = range(0, len(reference), BLOCK)
    largest = [(block(reference, i) - block(other, i)).abs().max() for i in firsts]
    return float(torch.stack(largest).max())


def timed(run: Callable[[], Any]) -> tuple[Any, float, float]:
    """Returns the result, the seconds of the first call and the median of the calls after it.

    Args:
        run: Function that returns when its result is there.
    """
    start = time.perf_counter()
    result = run()
    first, seconds = time.perf_counter() - start, []
    while sum(seconds) < LEAST_SECONDS:
        del result
        start = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - start)
    return result, first, statistics.median(seconds)


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


LINKS = (
    # length m, mass kg, moment of inertia across the link kg m², axis of its joint
    (0.16, 3.8, 0.020, "0 0 1"),
    (0.43, 8.4, 0.130, "0 1 0"),
    (0.39, 2.3, 0.035, "0 1 0"),
    (0.10, 1.2, 0.004, "0 1 0"),
    (0.10, 1.2, 0.004, "0 0 1"),
    (0.10, 0.6, 0.002, "0 1 0"),
)
"""An arm of the size of a UR5."""

TIME_STEP = 2e-3
"""Seconds per step of the arm."""


def arm_mjcf(case: str) -> str:
    """Returns the MJCF text of the arm; nothing collides.

    Args:
        case: One of :data:`CASES`.
    """
    friction = 'frictionloss="1"' if case == "dry friction" else ""
    bodies, place = "", "0 0 0.1"
    for i, (length, mass, moment, axis) in enumerate(LINKS, 1):
        bodies += (
            f'<body name="link_{i}" pos="{place}">'
            f'<joint name="joint_{i}" axis="{axis}" damping="2" armature="0.1" {friction}/>'
            f'<inertial pos="0 0 {length / 2}" mass="{mass}" '
            f'diaginertia="{moment} {moment} {moment / 4}"/>'
        )
        place = f"0 0 {length}"
    servos = "".join(
        f'<position name="servo_{i}" joint="joint_{i}" kp="400" kv="20" ctrlrange="-3 3"/>'
        for i in range(1, len(LINKS) + 1)
    )
    return (
        f'<mujoco><option timestep="{TIME_STEP}" integrator="implicitfast"/>'
        f"<worldbody>{bodies}{'</body>' * len(LINKS)}</worldbody>"
        f"<actuator>{servos}</actuator></mujoco>"
    )


def arm(case: str, num_threads: int) -> npdr.MujocoSimulator:
    """Returns the arm; the hand's mass and numbers of every joint and servo are parameters."""
    mujoco: Any = importlib.import_module("mujoco")
    joints = range(1, len(LINKS) + 1)
    parameters = {"hand_mass": "body link_6 mass"}
    parameters |= {f"damping_{i}": f"joint joint_{i} damping" for i in joints}
    parameters |= {f"kp_{i}": f"actuator servo_{i} kp" for i in joints}
    if case == "dry friction":
        parameters |= {f"friction_{i}": f"joint joint_{i} frictionloss" for i in joints}
    model = mujoco.MjModel.from_xml_string(arm_mjcf(case))
    return npdr.MujocoSimulator(model, parameters, num_threads=num_threads)


@dataclass(frozen=True)
class Replay:
    """Parameter sets and segments that the arm simulates, all combinations of them.

    Attributes:
        parameters: By name, ``(P,)``.
        inputs: S segments.
    """

    parameters: Mapping[str, Tensor]
    inputs: npdr.Inputs

    @property
    def flat(self) -> dict[str, Tensor]:
        """The parameters of all simulations, ``(P S,)``."""
        num_segments = self.inputs.num_segments
        return {n: v.repeat_interleave(num_segments) for n, v in self.parameters.items()}


def arm_replay(simulator: npdr.MujocoSimulator, size: int) -> Replay:
    """Returns random parameters within ±20 % and random slow commands of the servos."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return 2.0 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1.0

    segments = min(NUM_SEGMENTS, size)
    nominal = simulator.nominal()
    parameters = {n: v * (1.0 + 0.2 * uniform(size // segments)) for n, v in nominal.items()}
    joints = len(LINKS)
    times = TIME_STEP * torch.arange(NUM_STEPS, dtype=torch.float64)[:, None]
    start, rate = uniform(segments, 1, joints), 2.0 * uniform(segments, 1, joints)
    state = torch.cat((start[:, 0], torch.zeros(segments, joints)), dim=-1)
    return Replay(
        parameters,
        npdr.Inputs(
            actions=start + 0.3 * torch.sin(rate * times * torch.pi),
            action_names=tuple(action.name for action in simulator.actions),
            initial_readings=state,
            initial_values=state,
            channel_names=tuple(channel.name for channel in simulator.states),
            past_actions=torch.zeros(segments, 0, joints, dtype=torch.float64),
            time_step=TIME_STEP,
            mask=torch.ones(segments, NUM_STEPS, dtype=torch.bool),
            rollout=torch.zeros(segments, dtype=torch.long),
            start=torch.zeros(segments, dtype=torch.long),
        ),
    )


def mjx_rows(sizes: list[int], num_threads: int) -> Iterator[Row]:
    """The arm in MuJoCo on the CPU and in MJX, in single and double precision."""
    is_installed = bool(_found("jax") and _found("mujoco.mjx"))
    for case in CASES:
        simulator = arm(case, num_threads)
        for size in sizes if case == CASES[0] else [max(sizes)]:
            replay = arm_replay(simulator, size)
            work = size * NUM_STEPS

            def native(simulator: Any = simulator, replay: Replay = replay) -> np.ndarray:
                return simulator.simulate(replay.parameters, replay.inputs).flatten(0, 1).numpy()

            reference, first, seconds = timed(native)
            yield Row("mjx", case, size, "MuJoCo, cpu", seconds, first, work)
            if not is_installed:
                yield Row("mjx", case, size, "MJX", note="mjx is not installed")
                continue
            for precision in (32, 64) if size == max(sizes) else (32,):
                where = f"MJX float{precision}, {_jax_device()}"
                result, first, seconds = timed(mjx_replay(simulator, replay, precision))
                difference = largest_difference(reference, result)
                yield Row("mjx", case, size, where, seconds, first, work, difference)


def _found(module: str) -> bool:
    """Returns whether a module is installed, without importing it."""
    return importlib.util.find_spec(module) is not None


def _jax_device() -> str:
    """Returns where JAX computes."""
    jax: Any = importlib.import_module("jax")
    return "cuda" if jax.default_backend() == "gpu" else jax.default_backend()


def mjx_replay(
    simulator: npdr.MujocoSimulator, replay: Replay, precision: int
) -> Callable[[], np.ndarray]:
    """Returns a function that simulates in MJX what ``simulator`` would, from and to NumPy arrays.

    Args:
        simulator: The arm, whose bindings set the model's fields.
        replay: What to simulate.
        precision: Bits of a number, 32 or 64.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # torch needs memory too
    jax: Any = importlib.import_module("jax")
    mujoco: Any = importlib.import_module("mujoco")
    mjx: Any = importlib.import_module("mujoco.mjx")
    jax.config.update("jax_enable_x64", precision == 64)
    # GPUs would otherwise multiply matrices with ten bits of mantissa.
    jax.config.update("jax_default_matmul_precision", "highest")
    dtype = np.dtype(f"float{precision}")
    inputs, flat = replay.inputs, replay.flat
    size = len(next(iter(flat.values())))
    batch, _ = simulator.make_batch(flat, size, TIME_STEP, torch.zeros(()))
    changed_fields = {*simulator.bindings.arrays, *DERIVED}
    fields = {name: batch.expand(name).astype(dtype) for name in changed_fields}
    segment = np.arange(size) % inputs.num_segments
    state, commands = (v.numpy().astype(dtype) for v in (inputs.initial_values, inputs.actions))
    model = batch.model
    device_model = mjx.put_model(model)
    blank = mjx.put_data(model, mujoco.MjData(model))

    def one(own: dict[str, Any], row: Any, states: Any, actions: Any) -> Any:
        changed = device_model.replace(**own)
        start = states[row]
        data = blank.replace(qpos=start[: model.nq], qvel=start[model.nq :])

        def step(data: Any, action: Any) -> tuple[Any, Any]:
            data = mjx.step(changed, data.replace(ctrl=action))
            return data, jax.numpy.concatenate((data.qpos, data.qvel))

        return jax.lax.scan(step, data, actions[row])[1]

    run = jax.jit(jax.vmap(one, in_axes=(0, 0, None, None)))
    return lambda: np.array(run(fields, segment, state, commands))


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
