"""The delay of a command, from recordings with jitter and losses at four rates.

    python benchmarks/delays.py

A pendulum is simulated by Runge-Kutta steps of 1 ms. Its torque acts some milliseconds after the
command. Commands and measurements happen at times of their own: regular, up to 5 ms earlier or
later, or so and with 5 % lost. Each recording is fitted by the zoo's pendulum with a delay; the
exit status is 1 if an estimate errs by more than ``--tolerance``.
"""

import argparse

import numpy as np

import npdr_ppl as npdr
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.models.effects import InputDelay
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.gridding import recording_of
from npdr_ppl.rollouts.tracks import Track

DURATION = 20.0
FINE_STEP = 0.001
FIRST_SEED = 3
JITTER = 0.005
LOST = 0.05
MASS, LENGTH = 1.1, 0.9
NOISE = 2e-3, 2e-2
"""Standard deviations of the measured angle in rad and velocity in rad/s."""

KINDS = ("regular", "jitter", "jitter and losses")


def recorded(kind: str, step: float, delay: float, seed: int) -> Rollouts:
    """Returns a recording.

    Args:
        kind: One of ``KINDS``.
        step: Mean seconds between two measurements, and between two commands.
        delay: Delay of the torque in s.
        seed: Seed of the excitation, the clocks and the noise.
    """
    rng = np.random.default_rng(seed)
    num = round(DURATION / step)
    size = 0.0 if kind == "regular" else JITTER
    # At short steps, moved times overtake each other; what happens is in the order of time.
    commanded, measured = (
        np.unique(np.clip(step * np.arange(num) + rng.uniform(-size, size, num), 0.0, DURATION))
        for _ in range(2)
    )
    phases = rng.uniform(0.0, 2.0 * np.pi, 2)
    torque = 2.0 * np.sin(np.pi * commanded + phases[0])
    torque += 1.5 * np.sign(np.sin(2.0 * np.pi * 0.9 * commanded + phases[1]))
    time, states = simulated(commanded, torque, delay)
    columns = [
        np.interp(measured, time, states[:, k]) + NOISE[k] * rng.standard_normal(len(measured))
        for k in range(2)
    ]
    lost = LOST if kind.endswith("losses") else 0.0
    kept, sent = (rng.random(len(times)) > lost for times in (measured, commanded))
    channels = [Track.of(measured[kept], column[kept]) for column in columns]
    return Rollouts.of(
        recording_of(
            [(channels, [Track.of(commanded[sent], torque[sent])])],
            [("angle", "rad"), ("velocity", "rad/s")],
            [("torque", "N m")],
        )
    )


def simulated(
    commanded: np.ndarray, torque: np.ndarray, delay: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns times ``(N,)`` and angles and velocities ``(N, 2)`` of the pendulum."""

    def slope(time: float, state: np.ndarray) -> np.ndarray:
        last = int(np.searchsorted(commanded, time - delay, side="right")) - 1
        acting = torque[last] if last >= 0 else 0.0
        weight = 0.5 * MASS * 9.81 * LENGTH * np.sin(state[0])
        return np.array([state[1], (acting - weight) / (MASS * LENGTH**2 / 3.0)])

    time, h = np.arange(0.0, DURATION + FINE_STEP, FINE_STEP), FINE_STEP
    state, states = np.array([0.3, 0.0]), []
    for at in time:
        states.append(state)
        k1 = slope(at, state)
        k2 = slope(at + h / 2, state + h / 2 * k1)
        k3 = slope(at + h / 2, state + h / 2 * k2)
        k4 = slope(at + h, state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return time, np.array(states)


def main() -> int:
    """Runs the benchmark and prints its figures; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--steps", default="0.005,0.01,0.02,0.05", help="s")
    parser.add_argument("--delay", type=float, default=0.012, help="s")
    parser.add_argument("--seeds", type=int, default=10, help="how many, from 3")
    parser.add_argument("--tolerance", type=float, default=0.001, help="s")
    options = parser.parse_args()
    model, worst = add_effect(pendulum, InputDelay("torque")), 0.0
    for step in map(float, options.steps.split(",")):
        for kind in KINDS:
            found = []
            for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
                rollouts = recorded(kind, step, options.delay, seed)
                parameters = prepare(model, rollouts, npdr.DataOptions()).hypothesis.parameters
                found += [v.item() for name, v in parameters.items() if "delay" in name]
            errors = np.abs(np.array(found) - options.delay)
            worst = max(worst, errors.max())
            print(
                f"{1e3 * step:3.0f} ms, {kind:18}: {1e3 * min(found):.1f} to "
                f"{1e3 * max(found):.1f} ms, error {1e3 * np.median(errors):.2f} ms in the median",
                flush=True,
            )
    print(f"largest error {1e3 * worst:.1f} ms of {1e3 * options.delay:g} ms")
    return int(worst > options.tolerance)


if __name__ == "__main__":
    raise SystemExit(main())
