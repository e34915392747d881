"""Environment steps per second and core: the Furuta swing-up, policy and reward included.

Every variant runs the same episodes (policies × domains × initial states, constant-acceleration
integrator at 500 Hz, energy and PD policy, reward, early end at the state bounds) and is checked
against the eager float64 loop before it is timed; only MuJoCo integrates by Runge-Kutta (and is
checked against that).

    python benchmarks/simulation.py            # about two minutes
    python benchmarks/simulation.py --quick    # smaller batches, for a smoke test

Rates are medians over repeats, by wall clock and by processor time; they differ where other
programs share the core.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from npdr_ppl.models.furuta import Furuta, SwingUpReward, initial_states
from npdr_ppl.models.furuta_mujoco import FurutaRig
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp

TIME_STEP = 0.002
ARM_BOUND, POLE_BOUND, RATE_BOUND = math.radians(115.0), 4.0 * math.pi, 20.0 * math.pi
CONE = 1.0 - math.cos(math.radians(20.0))
WEIGHTS = (0.3, 1.0, 0.02, 0.005, 0.004)
VARIED = ("pole_mass", "pole_length", "arm_mass", "arm_length", "motor_resistance")


class Episodes(NamedTuple):
    """What is simulated: policies, domains and initial states, on an axis each."""

    policies: torch.Tensor
    domains: dict[str, torch.Tensor]
    states: torch.Tensor

    @property
    def size(self) -> int:
        """Number of episodes."""
        return len(self.policies) * len(self.states) * len(self.domains["gravity"])

    def flat(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Policies (7), domains (9) and states (4) of each episode, as float64 rows."""
        shape = (len(self.policies), len(self.domains["gravity"]), len(self.states))
        policies = self.policies.expand(*shape, 7).reshape(-1, 7)
        domains = torch.stack([v.expand(shape) for v in self.domains.values()], -1)
        states = self.states.expand(*shape, 4).reshape(-1, 4)
        return tuple(x.double().numpy().copy() for x in (policies, domains.reshape(-1, 9), states))  # type: ignore[return-value]


def make_episodes(num_policies: int, num_domains: int, num_states: int) -> Episodes:
    """Policies about the default gains in domains about the nominal one."""
    generator = torch.Generator().manual_seed(0)
    gains = FurutaSwingUp().parameters
    spread = torch.tensor([0.2, 0.2, 0.1, 0.2, 2.0, 0.1, 0.2])
    noise = torch.randn(num_policies, 1, 1, 7, generator=generator)
    domains = {}
    for parameter in Furuta.parameters:
        factor = torch.ones(num_domains, 1)
        if parameter.name in VARIED:
            factor += 0.1 * torch.randn(num_domains, 1, generator=generator)
        domains[parameter.name] = parameter.nominal * factor
    return Episodes(gains + spread * noise, domains, initial_states(num_states, generator))


def torch_loop(
    mode: str, dtype: torch.dtype = torch.float32, integrator: str | None = None
) -> Callable[..., np.ndarray]:
    """The library's own loop."""
    simulator, reward = Furuta(integrator=integrator), SwingUpReward(*WEIGHTS)
    policy = FurutaSwingUp()

    def run(episodes: Episodes, num_steps: int) -> np.ndarray:
        out = simulator.roll_out(
            {name: value.to(dtype) for name, value in episodes.domains.items()},
            policy.with_parameters(episodes.policies.to(dtype)),
            episodes.states.to(dtype),
            num_steps,
            reward=reward,
            compile=mode,  # type: ignore[arg-type]
            expected_calls=10_000,  # as in a study, which is worth the most thorough kernel
        )
        return out.returns.numpy().ravel()

    return run


class NumpyPendulum:
    """One environment, stepped as reference implementations do: small arrays, one at a time."""

    def __init__(self, domain: np.ndarray) -> None:
        self.gravity, self.resistance, self.constant, *rest = domain
        self.arm_mass, self.arm_length, self.pole_mass, self.pole_length, *damping = rest
        self.arm_damping, self.pole_damping = damping
        pole_inertia = self.pole_mass * self.pole_length**2 / 12
        self.c0 = self.arm_mass * self.arm_length**2 / 12 + self.pole_mass * self.arm_length**2
        self.c1 = self.pole_mass * self.pole_length**2 / 4
        self.c2 = self.pole_mass * self.pole_length * self.arm_length / 2
        self.c3 = pole_inertia + self.c1
        self.c4 = self.pole_mass * self.pole_length * self.gravity / 2
        self.target = np.array([0.0, np.pi, 0.0, 0.0])
        self.weights = np.diag(WEIGHTS[:4])
        self.bounds = np.array([ARM_BOUND, POLE_BOUND, RATE_BOUND, RATE_BOUND])

    def reset(self, state: np.ndarray) -> np.ndarray:
        """Starts an episode."""
        self.state = state.copy()
        return self.state.copy()

    def accelerations(self, voltage: float) -> np.ndarray:
        """Solves the equations of motion."""
        _, alpha, theta_rate, alpha_rate = self.state
        sin, double = np.sin(alpha), np.sin(2 * alpha)
        cross = self.c2 * np.cos(alpha)
        mass = np.array([[self.c0 + self.c1 * sin**2, cross], [cross, self.c3]])
        torque = self.constant * (voltage - self.constant * theta_rate) / self.resistance
        arm = self.c1 * double * theta_rate * alpha_rate - self.c2 * sin * alpha_rate**2
        pole = -0.5 * self.c1 * double * theta_rate**2 + self.c4 * sin
        x = torque - self.arm_damping * theta_rate - arm
        return np.linalg.solve(mass, [x, -self.pole_damping * alpha_rate - pole])

    def advance(self, voltage: float) -> None:
        """Integrates over one step."""
        acceleration = self.accelerations(voltage)
        self.state[:2] += TIME_STEP * self.state[2:] + 0.5 * TIME_STEP**2 * acceleration
        self.state[2:] += TIME_STEP * acceleration

    def step(self, command: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Advances by one step; returns state, reward and whether the episode ended."""
        error = self.target - self.state
        error[1] = np.mod(error[1] + np.pi, 2 * np.pi) - np.pi
        cost = error @ self.weights @ error + WEIGHTS[4] * float(command @ command)
        reward = float(np.exp(-cost))
        voltage = float(np.clip(command, -4.0, 4.0)[0])
        self.advance(voltage)
        return self.state.copy(), reward, bool(np.any(np.abs(self.state) > self.bounds))


class NumpyPolicy:
    """The swing-up policy on one observation."""

    def __init__(self, parameters: np.ndarray, domain: np.ndarray) -> None:
        self.reference, self.gain = np.exp(parameters[:2])
        self.centring, self.gains = parameters[2], parameters[3:]
        gravity, resistance, constant, arm_mass, arm_length, pole_mass, pole_length, *_ = domain
        self.inertia = pole_mass * pole_length**2 / 12
        self.weight = pole_mass * gravity * pole_length
        self.volts = resistance / constant * arm_mass * arm_length
        self.target = np.array([0.0, np.pi, 0.0, 0.0])

    def __call__(self, state: np.ndarray) -> np.ndarray:
        """Returns the command."""
        cos = np.cos(state[1])
        if abs(1.0 + cos) < CONE:
            error = self.target - state
            error[1] = np.mod(error[1] + np.pi, 2 * np.pi) - np.pi
            return np.array([self.gains @ error])
        energy = 0.5 * self.inertia * state[3] ** 2 + 0.5 * self.weight * (1.0 - cos)
        sign = 1.0 if state[3] * cos >= 0.0 else -1.0
        pumped = self.gain * (energy - self.reference) * sign - self.centring * state[0]
        return np.array([self.volts * np.clip(pumped, -5.0, 5.0)])


def numpy_loop(
    environment: type[NumpyPendulum] = NumpyPendulum,
) -> Callable[[Episodes, int], np.ndarray]:
    """One rollout after the other, one step after the other."""

    def run(episodes: Episodes, num_steps: int) -> np.ndarray:
        returns = []
        for parameters, domain, start in zip(*episodes.flat(), strict=True):
            pendulum, policy = environment(domain), NumpyPolicy(parameters, domain)
            state, total = pendulum.reset(start), 0.0
            for _ in range(num_steps):
                state, reward, is_over = pendulum.step(policy(state))
                total += reward
                if is_over:
                    break
            returns.append(total)
        return np.array(returns)

    return run


def scalar_episode(p: Any, d: Any, x: Any, num_steps: int) -> Any:
    """One episode on float32 numbers, combinations of parameters hoisted; for numba."""
    f = np.float32
    h, half, one, two, five, four = f(0.002), f(2e-6), f(1.0), f(2.0), f(5.0), f(4.0)
    pi, turn, inverse_turn = f(math.pi), f(2.0 * math.pi), f(0.5 / math.pi)
    volts = d[1] / d[2] * d[3] * d[4]
    gain = np.exp(p[1]) * volts
    weight = f(0.5) * d[5] * d[0] * d[6]
    kinetic = gain * d[5] * d[6] * d[6] / f(24.0)
    potential, deficit = gain * weight, gain * (weight - np.exp(p[0]))
    centring, limit = p[2] * volts, five * volts
    moment = f(0.5) * d[5] * d[6]
    c1, c2 = f(0.5) * moment * d[6], moment * d[4]
    c0 = (d[3] / f(12.0) + d[5]) * d[4] * d[4]
    inverse_c3 = f(0.75) / c1
    motor = d[2] / d[1]
    drag, coupling = motor * d[2] + d[7], c2 * inverse_c3
    pole_drag, pole_gravity = d[8] * inverse_c3, -moment * d[0] * inverse_c3
    centrifugal = c1 * inverse_c3
    q0, q1, q2, q3, r = f(0.3), f(1.0), f(0.02), f(0.005), f(0.004)
    cone, arm_bound = f(CONE), f(ARM_BOUND)
    pole_bound, rate_bound = f(POLE_BOUND), f(RATE_BOUND)
    theta, alpha, omega, nu = x[0], x[1], x[2], x[3]
    total = f(0.0)
    for _ in range(num_steps):
        sin, cos = np.sin(alpha), np.cos(alpha)
        error = alpha - pi
        error = error - turn * np.rint(error * inverse_turn)
        if cos + one < cone:
            command = -(p[3] * theta + p[4] * error + p[5] * omega + p[6] * nu)
        else:
            surplus = kinetic * nu * nu - potential * cos + deficit
            if nu * cos < f(0.0):
                surplus = -surplus
            command = min(max(surplus - centring * theta, -limit), limit)
        cost = q0 * theta * theta + q1 * error * error + q2 * omega * omega + q3 * nu * nu
        total += np.exp(-(cost + r * command * command))
        voltage = min(max(command, -four), four)
        spin = sin * omega
        pole = pole_gravity * sin - pole_drag * nu + centrifugal * cos * spin * omega
        arm = motor * voltage - drag * omega
        arm -= two * c1 * cos * spin * nu - c2 * sin * nu * nu
        per_arm = coupling * cos
        a = (arm - c2 * cos * pole) / (c0 + c1 * sin * sin - c2 * cos * per_arm)
        b = pole - per_arm * a
        theta += h * omega + half * a
        alpha += h * nu + half * b
        omega += h * a
        nu += h * b
        inside = abs(theta) <= arm_bound and abs(alpha) <= pole_bound
        if not (inside and abs(omega) <= rate_bound and abs(nu) <= rate_bound):
            break
    return total


def numba_loop(fastmath: bool) -> Callable[..., np.ndarray]:
    """The scalar loop compiled, over all episodes on one thread."""
    import numba

    episode = numba.njit(fastmath=fastmath)(scalar_episode)

    @numba.njit(fastmath=fastmath)
    def all_episodes(policies, domains, states, num_steps, returns):
        for i in range(len(returns)):
            returns[i] = episode(policies[i], domains[i], states[i], num_steps)

    def run(episodes: Episodes, num_steps: int) -> np.ndarray:
        rows = [x.astype(np.float32) for x in episodes.flat()]
        returns = np.empty(len(rows[0]), np.float32)
        all_episodes(*rows, num_steps, returns)
        return returns

    return run


def mujoco_loop(episodes: Episodes, num_steps: int) -> np.ndarray:
    """mujoco.batch with RK4 on one thread, policy and reward batched in NumPy."""
    from mujoco.batch import Batch

    policies, domains, states = episodes.flat()
    names = list(episodes.domains)
    model = FurutaRig().model()
    model.opt.timestep = TIME_STEP
    batch = Batch(model, nsim=len(states), nthread=1)
    fields = {
        name: batch.expand(name)
        for name in (
            "body_mass", "body_inertia", "body_pos", "body_ipos", "dof_armature",
            "actuator_gainprm", "actuator_biasprm",
        )
    }  # fmt: skip
    unique, index = np.unique(domains, axis=0, return_inverse=True)
    for i, domain in enumerate(unique):
        rows = index.ravel() == i
        one = FurutaRig(dict(zip(names, domain, strict=True))).model()
        for name, values in fields.items():
            values[rows] = getattr(one, name)
    batch.set_const()
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    qpos[:], qvel[:] = states[:, :2], states[:, 2:]
    d = domains.T
    volts = d[1] / d[2] * d[3] * d[4]
    reference, gain = np.exp(policies[:, 0]), np.exp(policies[:, 1])
    weight = 0.5 * d[5] * d[0] * d[6]
    total, is_running = np.zeros(len(states)), np.ones(len(states), bool)
    bounds = np.array([ARM_BOUND, POLE_BOUND, RATE_BOUND, RATE_BOUND])
    for _ in range(num_steps):
        theta, alpha, omega, nu = *qpos.T, *qvel.T
        cos = np.cos(alpha)
        error = alpha - np.pi
        error = error - 2 * np.pi * np.rint(error / (2 * np.pi))
        balance = -(policies[:, 3:] * np.stack([theta, error, omega, nu], 1)).sum(1)
        energy = d[5] * d[6] ** 2 / 24 * nu**2 + weight * (1 - cos)
        pumped = gain * (energy - reference) * np.where(nu * cos >= 0, 1, -1)
        swing = volts * np.clip(pumped - policies[:, 2] * theta, -5, 5)
        command = np.where(1 + cos < CONE, balance, swing)
        terms = np.stack([theta, error, omega, nu, command], 1) ** 2 @ np.array(WEIGHTS)
        total += np.where(is_running, np.exp(-terms), 0.0)
        ctrl[:, 0] = command
        batch.step()
        is_running &= np.all(np.abs(np.concatenate((qpos, qvel), 1)) <= bounds, axis=1)
    return total


class Variant(NamedTuple):
    """One row of the table."""

    name: str
    run: Callable[[Episodes, int], np.ndarray]
    episodes: Episodes
    num_steps: int
    tolerance: float
    integrator: str = "constant-acceleration"


def check(variant: Variant, num_steps: int = 300) -> float:
    """Returns the 95th percentile of the relative error of returns against eager float64.

    The policy switches, so that single episodes may leave each other; most do not.

    Raises:
        SystemExit: The returns do not agree.
    """
    small = Episodes(
        variant.episodes.policies[:4],
        {name: value[:5] for name, value in variant.episodes.domains.items()},
        variant.episodes.states[:2],
    )
    truth = torch_loop("never", torch.float64, variant.integrator)(small, num_steps)
    error = np.abs(variant.run(small, num_steps) / truth - 1.0)
    worst = float(np.quantile(error, 0.95))
    if worst > variant.tolerance:
        raise SystemExit(f"{variant.name} disagrees with the eager loop by {worst:.1e}.")
    return worst


def measure(variant: Variant, num_repeats: int) -> dict[str, float]:
    """Returns the median rates in environment steps per second."""
    wall, processor = [], []
    work = variant.episodes.size * variant.num_steps
    for repeat in range(num_repeats + 1):
        start, start_cpu = time.perf_counter(), time.process_time()
        variant.run(variant.episodes, variant.num_steps)
        if repeat:  # the first run warms up and compiles
            wall.append(work / (time.perf_counter() - start))
            processor.append(work / (time.process_time() - start_cpu))
    return {"wall": statistics.median(wall), "cpu": statistics.median(processor)}


def main() -> None:
    """Checks and times all variants."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="smaller batches")
    parser.add_argument("--repeats", type=int, default=5, help="repeats per variant")
    parser.add_argument("--json", help="file to write the figures to")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scale = 5 if options.quick else 1
    small, middle = make_episodes(1, 5, 2), make_episodes(50 // scale, 50, 4)
    large = make_episodes(250 // scale, 50, 4)
    variants = [
        Variant(f"compiled, batch {middle.size}", torch_loop("always"), middle, 500, 1e-3),
        Variant(f"compiled, batch {large.size}", torch_loop("always"), large, 500, 1e-3),
        Variant(f"eager, batch {middle.size}", torch_loop("never"), middle, 250, 1e-3),
        Variant("(a) NumPy, one rollout at a time", numpy_loop(), small, 500, 1e-6),
        Variant("(b) numba, scalar", numba_loop(False), middle, 250, 1e-3),
        Variant("(b) numba, scalar, fastmath", numba_loop(True), middle, 250, 1e-3),
        Variant("(c) mujoco.batch, RK4", mujoco_loop, make_episodes(10, 25, 4), 100, 1e-3, "rk4"),
    ]
    errors = {variant.name: check(variant) for variant in variants}
    rates = {variant.name: measure(variant, options.repeats) for variant in variants}
    best = rates[variants[0].name]
    print(f"{'variant':36}{'M steps/s wall':>16}{'cpu':>9}{'compiled is':>14}{'error':>10}")
    for name, rate in rates.items():
        ratio = best["wall"] / rate["wall"]
        print(
            f"{name:36}{rate['wall'] / 1e6:16.3f}{rate['cpu'] / 1e6:9.3f}"
            f"{ratio:13.1f}×{errors[name]:10.1e}"
        )
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"rates": rates, "errors": errors}, file, indent=2)


if __name__ == "__main__":
    main()
