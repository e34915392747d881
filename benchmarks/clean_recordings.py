"""Sound recordings that look odd: how often is a fault reported?

    python benchmarks/clean_recordings.py --number 300

Seven kinds in turn: the pendulum, cart-pole and EMPS rigs of the discovery benchmark with nothing
missing; a pendulum that turns round and round, beyond the bound that its model declares; one that
rests most of the time; one with an encoder of 200 steps per turn; and a ball that bounces. The
truth is made by other integrators than the models'.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from hidden_rigs.cases import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.recording_repair import repair
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.notes import faults_among

STEP = 0.01
FIRST_SEED = 5000

RESTING_SPEED = 1e-3
"""Speed after a bounce, in m/s, below which the ball rests until the next row."""


def rig(name: str) -> Callable[[int], tuple[Callable, Rollouts]]:
    """Returns a maker of recordings of a rig."""

    def make(seed: int) -> tuple[Callable, Rollouts]:
        case = make_case(name, "null", (), seed=seed)
        return case.model, case.fit

    return make


def swinging(seed: int, kind: str) -> tuple[Callable, Rollouts]:
    """Returns a pendulum's recording, by Runge-Kutta steps of 1 ms."""
    rng = np.random.default_rng(seed)
    mass, length = rng.uniform(0.8, 1.2, 2)
    num = 1000
    time_ = STEP * np.arange(num)
    torque = 1.5 * np.sin(rng.uniform(2, 4) * time_ + rng.uniform(0, 6))
    if kind == "turning":
        torque = torque + 6.0
        torque = np.clip(torque, -8.0, 8.0)
    if kind == "resting":
        torque = np.where((time_ > 2.0) & (time_ < 3.0), torque, 0.0)
    state, states = np.array([0.0, 0.0]), []

    def slope(x: np.ndarray, value: float) -> np.ndarray:
        damping = 0.8 if kind == "resting" else 0.0
        weight = 0.5 * mass * 9.81 * length * np.sin(x[0])
        return np.array([x[1], (value - weight - damping * x[1]) / (mass * length**2 / 3.0)])

    for value in torque:
        states.append(state)
        for _ in range(10):
            k1 = slope(state, value)
            k2 = slope(state + 5e-4 * k1, value)
            k3 = slope(state + 5e-4 * k2, value)
            k4 = slope(state + 1e-3 * k3, value)
            state = state + 1e-3 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    states.append(state)
    readings = np.array(states) + rng.normal(0.0, [1e-3, 1e-2], (num + 1, 2))
    if kind == "coarse":
        count = 2.0 * np.pi / 200
        readings[:, 0] = np.round(np.array(states)[:, 0] / count) * count
    if kind == "resting":
        count = 2.0 * np.pi / 2048
        readings[:, 0] = np.round(np.array(states)[:, 0] / count) * count
    rollouts = Rollouts.from_arrays(
        [readings],
        [torque[:, None]],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=STEP,
    )
    return (damped if kind == "resting" else pendulum), rollouts


def damped(inputs: npdr.Inputs) -> torch.Tensor:
    """The zoo's pendulum with an unknown damping."""
    from npdr_ppl.models.pendulum import Pendulum

    parameters = {
        "mass": pyro.sample("mass", dist.Uniform(0.5, 2.0)),
        "length": pyro.sample("length", dist.Uniform(0.5, 1.5)),
        "damping": pyro.sample("damping", dist.Uniform(0.0, 2.0)),
    }
    return npdr.simulate("swing", Pendulum(), parameters, inputs)


def bouncing(seed: int) -> tuple[Callable, Rollouts]:
    """Returns a ball's recording, between whose bounces it falls exactly."""
    rng = np.random.default_rng(seed)
    gravity, restitution = 9.81, rng.uniform(0.75, 0.9)
    height, speed, rows = rng.uniform(1.0, 2.0), 0.0, []
    for _ in range(601):
        rows.append([height, speed])
        left = STEP
        while True:
            hit = (speed + np.sqrt(speed**2 + 2 * gravity * height)) / gravity
            if hit > left:
                break
            height, speed, left = 0.0, restitution * (gravity * hit - speed), left - hit
            if speed < RESTING_SPEED:  # infinitely many bounces follow in a finite time
                speed, left = 0.0, 0.0
                break
        height += speed * left - 0.5 * gravity * left**2
        speed -= gravity * left
    readings = np.array(rows) + rng.normal(0.0, [1e-3, 1e-2], (601, 2))

    def fall(parameters, initial_state, actions, time_step):  # noqa: ANN001, ANN202
        height, speed = initial_state.unbind(-1)
        states = []
        for _ in range(actions.shape[1]):
            for _ in range(20):
                step = time_step / 20
                speed = speed - step * parameters["gravity"]
                height = height + step * speed
                bounces = (height < 0) & (speed < 0)
                height = torch.where(bounces, -height, height)
                speed = torch.where(bounces, -parameters["restitution"] * speed, speed)
            states.append(torch.stack([height, speed], dim=-1))
        return torch.stack(states, dim=-2)

    ball = npdr.FunctionSimulator(
        fall,
        states=[npdr.Channel("height", "m"), npdr.Channel("speed", "m/s", rate_of="height")],
        parameters=[
            npdr.Parameter("gravity", "m/s²", 9.81),
            npdr.Parameter("restitution", "1", 0.8),
        ],
        time_step=STEP,
    )

    def model(inputs: npdr.Inputs) -> torch.Tensor:
        parameters = {
            "gravity": pyro.sample("gravity", dist.Uniform(9.0, 10.5)),
            "restitution": pyro.sample("restitution", dist.Uniform(0.5, 1.0)),
        }
        return npdr.simulate("drop", ball, parameters, inputs)

    rollouts = Rollouts.from_arrays([readings], channel_names=("height", "speed"), time_step=STEP)
    return model, rollouts


KINDS: dict[str, Callable[[int], tuple[Callable, Rollouts]]] = {
    "pendulum rig": rig("pendulum"),
    "cart-pole rig": rig("cart_pole"),
    "emps rig": rig("emps"),
    "turning": lambda seed: swinging(seed, "turning"),
    "resting": lambda seed: swinging(seed, "resting"),
    "coarse": lambda seed: swinging(seed, "coarse"),
    "bouncing": bouncing,
}


def main() -> None:
    """Runs the benchmark and prints its figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--number", type=int, default=300)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    options = parser.parse_args()
    torch.set_num_threads(1)
    begun = time.process_time()
    counts = {kind: [0, 0] for kind in KINDS}
    for k in range(options.number):
        kind = list(KINDS)[k % len(KINDS)]
        model, rollouts = KINDS[kind](options.first_seed + k)
        notes = repair(model, rollouts, segment_options(rollouts)).rollouts.notes
        faults = faults_among(notes)
        counts[kind][1] += 1
        if faults:
            counts[kind][0] += 1
            print(f"{kind}, seed {options.first_seed + k}: {' '.join(faults)}", flush=True)
    for kind, (reported, number) in counts.items():
        print(f"{kind:14} fault reported {reported} of {number}")
    reported = sum(r for r, _ in counts.values())
    print(f"all: {reported} of {options.number}, {time.process_time() - begun:.0f} CPU s")


if __name__ == "__main__":
    main()
