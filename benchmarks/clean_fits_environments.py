"""Recordings of two Gymnasium environments, from their recurrences written a second time.

Neither Gymnasium nor the package simulates here; a test compares both with Gymnasium.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from hidden_rigs.excitation import EXCITATIONS, Band
from hidden_rigs.mechanics import Array

from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts

__all__ = ["ENVIRONMENTS", "Environment", "record_environment"]

SIGNALS = ("multisine", "steps", "chirp", "multisine")
"""Excitation of each rollout; the last is held out."""

Step = Callable[[float, float, float, Mapping[str, float]], tuple[float, float]]
"""Returns position and velocity after a step, from those before it, a command and parameters."""


def pendulum_step(
    angle: float, velocity: float, torque: float, parameters: Mapping[str, float]
) -> tuple[float, float]:
    """Returns the state of Pendulum-v1 a step of 0.05 s later; angle 0 is upright."""
    mass, length = parameters["mass"], parameters["length"]
    torque = min(2.0, max(-2.0, torque))
    rate = 1.5 * 10.0 / length * math.sin(angle) + 3.0 * torque / (mass * length**2)
    velocity = min(8.0, max(-8.0, velocity + 0.05 * rate))
    return angle + 0.05 * velocity, velocity


def car_step(
    position: float, velocity: float, throttle: float, parameters: Mapping[str, float]
) -> tuple[float, float]:
    """Returns the state of MountainCarContinuous-v0 a step later; it keeps 32-bit numbers."""
    throttle = min(1.0, max(-1.0, throttle))
    velocity += parameters["power"] * throttle - 0.0025 * math.cos(3.0 * position)
    velocity = min(0.07, max(-0.07, velocity))
    position = min(0.6, max(-1.2, position + velocity))
    if position == -1.2 and velocity < 0.0:
        velocity = 0.0
    return float(np.float32(position)), float(np.float32(velocity))


@dataclass(frozen=True)
class Environment:
    """An environment and how it is recorded.

    Attributes:
        step: Its recurrence.
        prior: Ends of the uniform priors of its model, by parameter.
        channels: Names and units of position, velocity and command.
        time_step: Seconds per step.
        num_steps: Steps per rollout.
        amplitude: Greatest command.
        band: Frequencies of the excitation, in Hz.
        start: Centre and halfwidth of the position at the start; the velocity is zero.
        noise: Standard deviations of the readings.
    """

    step: Step
    prior: Mapping[str, tuple[float, float]]
    channels: tuple[tuple[str, str], ...]
    time_step: float
    num_steps: int
    amplitude: float
    band: Band
    start: tuple[float, float]
    noise: tuple[float, float]


ENVIRONMENTS = {
    "gymnasium_pendulum": Environment(
        step=pendulum_step,
        prior={"mass": (0.5, 1.5), "length": (0.5, 1.5)},
        channels=(("angle", "rad"), ("velocity", "rad/s"), ("torque", "N m")),
        time_step=0.05,
        num_steps=80,
        amplitude=2.0,
        band=Band(0.3, 2.0),
        start=(math.pi, 0.8),  # about hanging
        noise=(2e-3, 2e-2),
    ),
    "gymnasium_mountain_car": Environment(
        step=car_step,
        prior={"power": (0.0005, 0.0025)},
        channels=(("position", "m"), ("velocity", "m/s"), ("throttle", "1")),
        time_step=1.0,
        num_steps=120,
        amplitude=1.0,
        # About the valley's own frequency, √(3 · 0.0025)/2π = 0.014 Hz.
        band=Band(0.008, 0.04),
        start=(-0.5, 0.1),
        noise=(2e-3, 2e-4),
    ),
}
"""The environments by the file of their model in ``clean_fits_models``."""


def record_environment(
    name: str, parameters: Mapping[str, float], *, seed: int, is_noisy: bool = True
) -> Rollouts:
    """Records four rollouts of an environment.

    Args:
        name: Name of the environment.
        parameters: True values.
        seed: Seed of excitations, starts and noise.
        is_noisy: Whether readings have noise.
    """
    chosen = ENVIRONMENTS[name]
    generator = np.random.default_rng(derived_seed(seed, name, "clean recording"))
    time = chosen.time_step * np.arange(chosen.num_steps, dtype=np.float64)
    readings, actions = [], []
    for signal in SIGNALS:
        commands = chosen.amplitude * EXCITATIONS[signal](time, chosen.band, generator)
        middle, halfwidth = chosen.start
        states = [(middle + halfwidth * generator.uniform(-1.0, 1.0), 0.0)]
        for command in commands:
            states.append(chosen.step(*states[-1], command, parameters))
        values: Array = np.array(states)
        hiss = generator.standard_normal(values.shape) * np.array(chosen.noise)
        readings.append(values + hiss if is_noisy else values)
        actions.append(commands[:, None])
    names, units = zip(*chosen.channels, strict=True)
    return Rollouts.from_arrays(
        readings,
        actions,
        channel_names=names[:2],
        action_names=names[2:],
        time_step=chosen.time_step,
        channel_units=units[:2],
        action_units=units[2:],
    )
