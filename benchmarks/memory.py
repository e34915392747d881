"""Measures the peak memory of commands on a long recording: 60 s at 1 kHz, 7 channels.

    python benchmarks/memory.py --out memory.json
    python benchmarks/memory.py --seconds 25 --commands fit,compare
    python benchmarks/memory.py --model arm
    python benchmarks/memory.py --model arm-positions --commands discover

The recording is that of four pendulums, each driven by a torque of its own; the last one's
velocity is not measured. It is made here by a Runge-Kutta method, with noise. Each command runs in
a process of its own on one thread, whose peak resident memory, that of the imported libraries
included, is read at its end. The exit code is 1 if a command needs more than ``--limit`` GiB or
fails.

With ``--model arm``, the model is a ``MujocoSimulator`` of a MJCF file with seven hinges and seven
motors, and the recording, of 14 channels, is made by PyBullet; see ``seven_joint_arm.py``. With
``arm-positions``, the positions alone are recorded. ``npdr fit`` and ``npdr discover`` run with
all defaults on one thread, and the memory of all their processes together is sampled.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.ode.simulator import Forces, ODESimulator
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.inputs import Inputs

NUM_LINKS = 4

HINGES = tuple(f"hinge_{i}" for i in range(NUM_LINKS))

TIME_STEP = 1e-3
"""Seconds."""

NOISE = 1e-3, 1e-2
"""Standard deviations of the recording's angles, rad, and velocities, rad/s."""

TRUE = 1.1, 0.9, 1.2, 1.0
"""Masses of the recording's pendulums, kg."""

SEGMENT_LENGTH = 200
"""Steps between two re-synchronisations."""

MODELS = "pendulums", "arm", "arm-positions"

COMMANDS = {
    "none": [],
    "fit": ["fit", "--rounds", "1", "--simulations", "500"],
    "compare": [
        "compare", "--backends", "snpe-c, small = snpe-c(hidden=(32,))", "--rounds", "1",
        "--simulations", "500",
    ],
    "discover": ["discover"],
}  # fmt: skip
"""Words of each command; ``none`` imports the libraries and does nothing."""


class Pendulums(ODESimulator):
    """Pendulums side by side, 1 m long: m l²/3 θ̈ = τ − m g l/2 sin θ − d θ̇."""

    states = tuple(Channel(f"angle_{i}", "rad") for i in range(NUM_LINKS)) + tuple(
        Channel(f"velocity_{i}", "rad/s", rate_of=f"angle_{i}") for i in range(NUM_LINKS)
    )
    actions = tuple(Channel(f"torque_{i}", "N m", -5.0, 5.0) for i in range(NUM_LINKS))
    sensors = states
    parameters = tuple(Parameter(f"mass_{i}", "kg", 1.0) for i in range(NUM_LINKS)) + (
        Parameter("damping", "N m s/rad", 0.1),
    )
    joints = tuple(f"hinge_{i}" for i in range(NUM_LINKS))
    ports = (
        *(Port(f"torque_{i}", "action", "N m", rated=5.0) for i in range(NUM_LINKS)),
        *(
            Port(f"hinge_{i}", "force", "N m", rated=5.0, rated_speed=5.0)
            for i in range(NUM_LINKS)
        ),
        *(Port(f"angle_{i}", "sensor", "rad", rated=1.0) for i in range(NUM_LINKS)),
        *(Port(f"velocity_{i}", "sensor", "rad/s", rated=5.0) for i in range(NUM_LINKS)),
    )
    time_step = TIME_STEP
    default_integrator = "semi-implicit-euler"

    def constants(
        self, parameters: Mapping[str, Tensor], environment: Mapping[str, Any]
    ) -> dict[str, Tensor]:
        """Returns the inverse inertias and the damping."""
        inverse = {f"inverse_{i}": 3.0 / parameters[f"mass_{i}"] for i in range(NUM_LINKS)}
        return {**inverse, "damping": parameters["damping"]}

    def accelerations(
        self,
        positions: Components,
        velocities: Components,
        actions: Components,
        forces: Forces,
        constants: dict[str, Tensor],
    ) -> Components:
        """Returns θ̈."""
        return tuple(
            (torque + force - constants["damping"] * rate) * constants[f"inverse_{i}"]
            - 1.5 * 9.81 * torch.sin(angle)
            for i, (angle, rate, torque, force) in enumerate(
                zip(positions, velocities, actions, forces, strict=True)
            )
        )

    def inverse_inertia(
        self, positions: Components, velocities: Components, constants: dict[str, Tensor]
    ) -> tuple[Components, ...]:
        """Returns a diagonal matrix."""
        zero = torch.zeros_like(positions[0])
        return tuple(
            tuple(constants[f"inverse_{i}"] if i == j else zero for j in range(NUM_LINKS))
            for i in range(NUM_LINKS)
        )


def pendulums(inputs: Inputs) -> Tensor:
    """Four pendulums of unknown masses and one damping."""
    parameters = {
        f"mass_{i}": pyro.sample(f"mass_{i}", dist.Uniform(0.5, 2.0)) for i in range(NUM_LINKS)
    }
    parameters["damping"] = pyro.sample("damping", dist.Uniform(0.0, 0.5))
    return npdr.simulate("trajectory", Pendulums(), parameters, inputs)


def write_recording(path: Path, seconds: float) -> None:
    """Writes two rollouts, the second a tenth as long, to be held out; readings in rad and rad/s.

    Args:
        path: File of the recording.
        seconds: Duration of the first.
    """
    rng = np.random.default_rng(0)
    mass = np.array(TRUE)

    def rate(state: np.ndarray, torque: np.ndarray) -> np.ndarray:
        angle, velocity = state
        inertia = mass / 3.0
        weight = 0.5 * mass * 9.81 * np.sin(angle)
        return np.stack((velocity, (torque - weight - 0.2 * velocity) / inertia))

    readings, actions = [], []
    for duration in (seconds, 0.1 * seconds):
        steps = round(duration / TIME_STEP)
        frequency = rng.uniform(0.2, 1.5, (3, NUM_LINKS))
        phase = rng.uniform(0.0, 2.0 * math.pi, (3, NUM_LINKS))
        times = TIME_STEP * np.arange(steps)[:, None, None]
        torque = np.sin(2.0 * math.pi * frequency * times + phase).sum(1)
        state = np.zeros((2, NUM_LINKS))
        states = [state]
        for now in torque:
            first = rate(state, now)
            second = rate(state + 0.5 * TIME_STEP * first, now)
            state = state + TIME_STEP * second
            states.append(state)
        noise = rng.standard_normal((steps + 1, 2, NUM_LINKS)) * np.array(NOISE)[:, None]
        readings.append((np.array(states) + noise).reshape(steps + 1, -1)[:, :-1])
        actions.append(torque)
    npdr.Rollouts.from_arrays(
        readings=readings,
        actions=actions,
        channel_names=[channel.name for channel in Pendulums.sensors[:-1]],
        action_names=[channel.name for channel in Pendulums.actions],
        time_step=TIME_STEP,
    ).to_npz(path)


def measured(name: str, recording: Path, out: Path) -> dict[str, Any]:
    """Runs a command in a process of its own and returns its seconds and peak memory."""
    words = [
        sys.executable,
        __file__,
        "--child",
        name,
        "--data",
        str(recording),
        "--out",
        str(out),
    ]
    begin = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    last = done.stdout.splitlines()[-1] if done.stdout else ""
    peak = float(last.removeprefix("peak ")) if last.startswith("peak ") else None
    error = None if done.returncode == 0 else done.stderr.strip().splitlines()[-1:]
    return {"seconds": round(seconds, 1), "peak_gib": peak, "error": error}


def measured_arm(
    verbs: list[str],
    seconds: float,
    *,
    has_velocities: bool,
    time_limit: float,
    search_limit: float | None = None,
) -> dict[str, dict[str, Any]]:
    """Runs commands with a MJCF file on a recording of an arm; see the module's docstring.

    Args:
        verbs: The commands.
        seconds: Duration of the recording.
        has_velocities: Whether the velocities are recorded.
        time_limit: Seconds after which a command is ended.
        search_limit: Seconds after which ``npdr discover`` searches nothing further.
    """
    # Not at the top: npdr reads this file as a model, wherever its workers run.
    from clean_fits_runs import npdr_command, run
    from seven_joint_arm import write_arm
    from seven_joint_arm import write_recording as write_recording_of_arm

    rows = {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        model, recording = write_arm(folder), folder / "recording.npz"
        write_recording_of_arm(recording, seconds, has_velocities=has_velocities)
        for verb in verbs:
            out = folder / verb
            command = npdr_command(verb, model, recording, out, 1)
            if verb == "discover" and search_limit:
                command += ["--time-limit", str(search_limit)]
            done = run(command, time_limit=time_limit)
            rows[verb] = {
                "seconds": round(done.seconds, 1),
                "cpu_seconds": round(done.cpu_seconds, 1),
                "peak_gib": round(done.peak_bytes / 2**30, 3),
                "error": done.message or None,
            }
            print(verb, rows[verb], flush=True)
    return rows


def run_child(name: str, recording: Path, out: Path) -> int:
    """Runs a command in this process and prints its peak memory in GiB; returns its exit code."""
    from npdr_ppl.cli.main import main

    code: Any = 0
    if COMMANDS[name]:
        command, *rest = COMMANDS[name]
        model = f"{Path(__file__).resolve()}:pendulums"
        sys.argv = [
            "npdr", command, model, "--data", str(recording), "--out", str(out), "--quiet",
            "--holdout", "1", *rest,
        ]  # fmt: skip
        if command != "discover":
            sys.argv += ["--segment-length", str(SEGMENT_LENGTH)]
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak {peak:.3f}")
    return int(code)


def main() -> int:
    """Runs the commands; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--model", choices=MODELS, default=MODELS[0])
    parser.add_argument("--commands", help="default: all that the model has")
    parser.add_argument("--time-limit", type=float, default=7200.0, help="s, for the arm")
    parser.add_argument(
        "--search-limit", type=float, help="s, the arm's npdr discover --time-limit"
    )
    parser.add_argument("--limit", type=float, default=2.0, help="GiB")
    parser.add_argument("--out", type=Path, default=Path("memory.json"))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.child:
        torch.set_num_threads(1)
        return run_child(chosen.child, chosen.data, chosen.out)
    if chosen.model == MODELS[0]:
        rows = {}
        with TemporaryDirectory() as folder:
            recording = Path(folder) / "recording.npz"
            write_recording(recording, chosen.seconds)
            for name in chosen.commands.split(",") if chosen.commands else COMMANDS:
                rows[name] = measured(name, recording, Path(folder) / name)
                print(name, rows[name], flush=True)
    else:
        rows = measured_arm(
            (chosen.commands or "fit,discover").split(","),
            chosen.seconds,
            has_velocities=chosen.model == "arm",
            time_limit=chosen.time_limit,
            search_limit=chosen.search_limit,
        )
    found = {"model": chosen.model, "seconds": chosen.seconds, "commands": rows}
    chosen.out.write_text(json.dumps(found, indent=2))
    peaks = [row["peak_gib"] for row in rows.values()]
    failed = any(row["error"] for row in rows.values())
    return int(failed or any(peak is None or peak > chosen.limit for peak in peaks))


if __name__ == "__main__":
    sys.exit(main())
