"""The part ``mjx`` of ``gpu.py``: an arm of six joints in MuJoCo and in its engine MJX."""

import importlib
import importlib.util
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gpu_rows import NUM_STEPS, Row, largest_difference, timed
from torch import Tensor

import npdr_ppl as npdr

__all__ = ["arm", "arm_mjcf", "arm_replay", "mjx_replay", "mjx_rows"]

NUM_SEGMENTS = 64
"""Segments of commands that the arm replays; the other simulations differ in their parameters."""

DERIVED = ("dof_invweight0",)
"""Fields that the engine computes from the parameters and that dry friction depends on."""

CASES = "smooth", "dry friction"
"""Arms of the part ``mjx``."""


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
