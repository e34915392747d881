"""A recording of a pendulum with dry friction, which the zoo's model has not.

Equations, friction and integrator are this file's own; nothing of the package is under them.
"""

import math

import numpy as np

from npdr_ppl.rollouts import Rollouts

FRICTION = 0.35
"""Newton metres, of 4.5 that the motor has."""

MISSING = "hinge.coulomb_friction"

CANDIDATES = "hinge.coulomb_friction,torque.actuator_gain,hinge.bias"
"""Few, so that a search takes seconds."""

MASS, LENGTH = 0.9, 1.1
"""Kilograms and metres of the rod, which nothing damps."""

STEP, SUBSTEPS = 0.02, 100
"""Seconds between readings, and integration steps in between."""


def swing(angle, velocity, torque):
    """Returns angle and velocity of a rod with dry friction after one step of its motor."""
    inertia, dt = MASS * LENGTH**2 / 3.0, STEP / SUBSTEPS
    for _ in range(SUBSTEPS):
        free = velocity + dt * (torque - 0.5 * MASS * 9.81 * LENGTH * math.sin(angle)) / inertia
        # Friction takes what it can of the velocity, and holds what it can take all of.
        velocity = math.copysign(max(0.0, abs(free) - dt * FRICTION / inertia), free)
        angle += dt * velocity
    return angle, velocity


def pendulum_recording(num_rollouts=4, num_steps=250):
    """Returns noisy rollouts under sums of two sines; the last has other frequencies."""
    time, rng = STEP * np.arange(num_steps), np.random.default_rng(0)
    readings, actions = [], []
    for k in range(num_rollouts):
        slow, fast = 2 * math.pi * (0.4 + 0.15 * k), 2 * math.pi * (1.1 + 0.1 * k)
        torque = 2.0 * np.sin(slow * time) + 1.5 * np.sin(fast * time + k)
        states = [(0.3 * k - 0.4, 0.0)]
        for command in torque:
            states.append(swing(*states[-1], command))
        noise = rng.standard_normal((num_steps + 1, 2))
        readings.append(np.array(states) + [0.002, 0.02] * noise)
        actions.append(torque[:, None])
    return Rollouts.from_arrays(
        readings=readings, actions=actions, channel_names=("angle", "velocity"),
        action_names=("torque",), time_step=STEP,
    )  # fmt: skip
