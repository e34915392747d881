"""A policy that is trained outside of this package, on the ranges that a run exported.

    python examples/policy_elsewhere.py --out elsewhere

1. A hidden rig, a pendulum with a motor, is recorded. It is equations in NumPy and a Runge-Kutta
   integrator. Its load is heavier than in the robot's file, its bearing has dry friction, and its
   commands arrive late.
2. ``npdr discover`` gets the robot's file and the recording, and finds what is missing.
3. ``npdr export --as gymnasium`` writes a wrapper that takes another draw at every reset.
4. A cross-entropy search of a few lines trains three gains to raise the load and hold it: once in
   the environment of the robot's file, once in the wrapper.
5. Both policies, and none, control the hidden rig. Printed are the returns, −∫ (q − 1.2 rad)² dt,
   and how far from its target the load is in the second half, in rad.
"""

import argparse
import math
import runpy
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TIME_STEP, TARGET, LIMIT = 0.01, 1.2, 1.0
"""Seconds between commands; the angle to reach in rad; the motor's limit in N m."""

ROBOT = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.004"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.005" mass="0.03"/>
      <body name="load" pos="0 0 -0.2"><geom type="sphere" size="0.03" mass="0.12"/></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""

MODEL = """
import pyro, pyro.distributions as dist
import npdr_ppl as npdr

FIELDS = {"load": "body load mass_and_inertia", "damping": "joint hinge damping"}
arm = npdr.MujocoSimulator("robot.xml", FIELDS, time_step=0.01)


def model(inputs):
    given = {
        "load": pyro.sample("load", dist.Uniform(0.05, 0.3)),  # kg
        "damping": pyro.sample("damping", dist.Uniform(0.0, 0.02)),  # N m s/rad
    }
    return npdr.simulate("trajectory", arm, given, inputs)
"""

NUM_SEEDS = 3
"""Searches of each kind; a search by chance is no result."""

Policy = Callable[[float, float], float]
"""Returns a torque in N m for an angle in rad and a velocity in rad/s."""


class HiddenRig:
    """The pendulum that stands in for a real one.

    Attributes:
        load: Mass at the end in kg.
        damping: Viscous friction in N m s/rad.
        friction: Dry friction in N m.
        delay: Delay of commands in s.
    """

    load, damping, friction, delay = 0.17, 0.004, 0.02, 0.028
    rod, length, radius, step = 0.03, 0.2, 0.03, 5e-4

    def run(self, command: Callable[[int, float, float], float], num_steps: int) -> Array:
        """Returns angle, velocity and command of every step, ``(num_steps + 1, 3)``."""
        inertia = (self.rod / 3.0 + self.load) * self.length**2 + 0.4 * self.load * self.radius**2
        weight = 9.81 * self.length * (0.5 * self.rod + self.load)

        def rates(state: Array, torque: float) -> Array:
            q, v = state
            # Near rest, dry friction is a steep line: 5 mrad/s are its width.
            dry = self.friction * math.tanh(v / 0.005)
            return np.array(
                [v, (torque - weight * math.sin(q) - self.damping * v - dry) / inertia]
            )

        state, rows = np.zeros(2), []
        late = deque([0.0] * round(self.delay / self.step))
        for number in range(num_steps):
            chosen = min(max(command(number, *state), -LIMIT), LIMIT)
            rows.append([*state, chosen])
            for _ in range(round(TIME_STEP / self.step)):
                late.append(chosen)
                torque, h = late.popleft(), self.step
                a = rates(state, torque)
                b = rates(state + 0.5 * h * a, torque)
                c = rates(state + 0.5 * h * b, torque)
                d = rates(state + h * c, torque)
                state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        return np.array([*rows, [*state, np.nan]])


def record(rig: HiddenRig, file: Path, *, num_steps: int = 600, seed: int = 0) -> None:
    """Records three rollouts under sums of sines, with the noise of an encoder."""
    random = np.random.default_rng(seed)
    lines = ["rollout,time,hinge,hinge_velocity,motor"]
    for rollout in range(3):
        rates, phases = random.uniform(1.0, 12.0, 5), random.uniform(0.0, 6.28, 5)

        def command(
            number: int, q: float, v: float, rates: Array = rates, phases: Array = phases
        ) -> float:
            return float(0.08 * np.sin(rates * TIME_STEP * number + phases).sum())

        for number, (q, v, u) in enumerate(rig.run(command, num_steps)):
            q, v = q + random.normal(0.0, 0.002), v + random.normal(0.0, 0.02)
            held = "" if math.isnan(u) else f"{u:.6f}"
            lines.append(f"{rollout},{TIME_STEP * number:.2f},{q:.6f},{v:.6f},{held}")
    file.write_text("\n".join(lines) + "\n")


def npdr(*words: str, folder: Path) -> None:
    """Runs the command line in a folder."""
    command = Path(sys.executable).with_name("npdr")
    subprocess.run([str(command), *words], cwd=folder, check=True)


def environment(folder: Path) -> Any:
    """Returns the robot's file as a Gymnasium environment."""
    from gymnasium import spaces
    from gymnasium.envs.mujoco import MujocoEnv

    class Raise(MujocoEnv):
        """The load is to be raised."""

        metadata: ClassVar[dict[str, Any]] = {
            "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
            "render_fps": 100,
        }

        def reset_model(self) -> Array:
            return np.concatenate([self.data.qpos, self.data.qvel])

        def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
            self.do_simulation(action, self.frame_skip)
            observed = np.concatenate([self.data.qpos, self.data.qvel])
            return observed, -TIME_STEP * float((observed[0] - TARGET) ** 2), False, False, {}

    box = spaces.Box(-np.inf, np.inf, shape=(2,))
    return Raise(str((folder / "robot.xml").resolve()), 5, box)


def policy_of(gains: Array) -> Policy:
    """Returns a torque that is constant, plus one of the error, minus one of the velocity."""
    constant, stiffness, damping = (float(g) for g in gains)
    return lambda q, v: constant + stiffness * (TARGET - q) - damping * v


def episode(env: Any, policy: Policy, num_steps: int, seed: int) -> float:
    """Returns the return of an episode in an environment."""
    (q, v), _ = env.reset(seed=seed)
    total = 0.0
    for _ in range(num_steps):
        torque = min(max(policy(q, v), -LIMIT), LIMIT)
        (q, v), reward, *_ = env.step(np.array([torque]))
        total += reward
    return total


def train(
    env: Any, *, iterations: int = 12, candidates: int = 16, num_steps: int = 250, seed: int = 0
) -> Array:
    """Returns gains that a cross-entropy search finds; it knows only the environment."""
    random = np.random.default_rng(seed)
    mean, spread = np.array([0.0, 1.0, 0.1]), np.array([0.3, 2.0, 0.15])
    for iteration in range(iterations):
        tried = mean + spread * random.standard_normal((candidates, 3))
        tried[:, 1:] = np.abs(tried[:, 1:])
        draws = [3 * iteration + k for k in range(3)]
        returns = [
            np.mean([episode(env, policy_of(row), num_steps, draw) for draw in draws])
            for row in tried
        ]
        best = tried[np.argsort(returns)[-candidates // 4 :]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.01
    return mean


def on_the_rig(rig: HiddenRig, policy: Policy, num_steps: int = 250) -> tuple[float, float]:
    """Returns the return on the rig, and the root mean square error in the second half in rad."""
    angles = rig.run(lambda _, q, v: policy(q, v), num_steps)[1:, 0]
    errors = angles - TARGET
    late = errors[num_steps // 2 :]
    return -TIME_STEP * float((errors**2).sum()), float(np.sqrt((late**2).mean()))


def identify(folder: Path, *options: str, num_steps: int = 600) -> Any:
    """Records the rig, finds what the robot's file lacks, and exports it; returns the wrapper.

    Args:
        folder: Where all files go.
        options: Further options of ``npdr discover``.
        num_steps: Steps of each recorded rollout.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(ROBOT)
    (folder / "model.py").write_text(MODEL)
    record(HiddenRig(), folder / "measured.csv", num_steps=num_steps)
    found = ("discover", "model.py:model", "--data", "measured.csv", "--out", "found")
    npdr(*found, *options, folder=folder)
    npdr("export", "found", "--to", "pendulum_gym.py", "--as", "gymnasium", folder=folder)
    return runpy.run_path(str(folder / "pendulum_gym.py"))["RandomisedRobot"]


def compare(folder: Path, wrapper: Any, **options: int) -> dict[str, tuple[float, float]]:
    """Returns what each policy reaches on the hidden rig; see :func:`on_the_rig`."""
    policies = {
        "none": np.zeros(3),
        "trained on the robot's file": train(environment(folder), **options),
        "trained on the exported draws": train(wrapper(environment(folder)), **options),
    }
    return {name: on_the_rig(HiddenRig(), policy_of(g)) for name, g in policies.items()}


def main() -> None:
    """Runs all steps and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("elsewhere"))
    folder = parser.parse_args().out
    wrapper = identify(folder)
    print(f"\n{'seed':6}{'policy':32}{'return':>10}{'late error':>12}")
    for seed in range(NUM_SEEDS):
        for name, (total, error) in compare(folder, wrapper, seed=seed).items():
            print(f"{seed:<6}{name:32}{total:10.2f}{error:12.3f}")


if __name__ == "__main__":
    main()
