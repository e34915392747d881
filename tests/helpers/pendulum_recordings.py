"""Recordings of a driven pendulum by an integrator of their own, and models to fit to them.

Runge-Kutta steps of 1 ms in NumPy; nothing of the package's engines is used.
"""

import numpy as np
import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.rollouts import Rollouts

TRUTH = {"mass": 1.1, "length": 0.9}
"""kg and m."""

NOISE = {"angle": 0.002, "velocity": 0.01}
"""Standard deviations of the measurements, rad and rad/s."""

TIME_STEP, SUBSTEPS = 0.02, 20


def swinging(*, rollouts=3, steps=250, friction=0.0, noise=NOISE, seed=0):
    """Returns rollouts of the pendulum under three sines of torque.

    Args:
        rollouts: Their number.
        steps: Samples of each, 20 ms apart.
        friction: Dry friction at the hinge, N m.
        noise: Standard deviations of the measurements, rad and rad/s.
        seed: Seed of torques, initial states and noise.
    """
    generator = np.random.default_rng(seed)
    readings, actions = [], []
    for _ in range(rollouts):
        state = np.array([generator.uniform(-1.0, 1.0), 0.0])
        rates, phases = generator.uniform(0.2, 1.5, 3), generator.uniform(0.0, 2.0 * np.pi, 3)
        time = np.arange(steps) * TIME_STEP
        torque = 0.7 * np.sin(2.0 * np.pi * rates[:, None] * time + phases[:, None]).sum(0)
        states = [state]
        for command in torque:
            for _ in range(SUBSTEPS):
                state = _step(state, command, friction, TIME_STEP / SUBSTEPS)
            states.append(state)
        errors = generator.standard_normal((steps + 1, 2)) * [noise["angle"], noise["velocity"]]
        readings.append(np.array(states) + errors)
        actions.append(torque[:, None])
    return Rollouts.from_arrays(
        readings=readings,
        actions=actions,
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=TIME_STEP,
    )


def jerked(*, steps=800, every=20, seed=0):
    """Returns a rollout of angles under a torque that jumps, and the true velocities.

    Args:
        steps: Number of steps.
        every: Steps between jumps.
        seed: Seed of the torques and the noise.
    """
    generator = np.random.default_rng(seed)
    torque = generator.uniform(-0.8, 0.8, -(-steps // every)).repeat(every)[:steps]
    states = [np.zeros(2)]
    for command in torque:
        state = states[-1]
        for _ in range(SUBSTEPS):
            state = _step(state, command, 0.0, TIME_STEP / SUBSTEPS)
        states.append(state)
    angles, velocities = np.array(states).T
    noisy = angles + 1e-4 * generator.standard_normal(steps + 1)
    rollouts = Rollouts.from_arrays(
        readings=[noisy[:, None]],
        actions=[torque[:, None]],
        channel_names=("angle",),
        action_names=("torque",),
        time_step=TIME_STEP,
    )
    return rollouts, velocities


def product(inputs):
    """A pendulum of whose mass a recording shows only the product of density and volume."""
    density = pyro.sample("density", dist.Uniform(0.5, 2.0))
    volume = pyro.sample("volume", dist.Uniform(0.5, 2.0))
    length = pyro.sample("length", dist.Uniform(0.3, 1.7))
    parameters = {"mass": density * volume, "length": length}
    return npdr.simulate("trajectory", Pendulum(), parameters, inputs)


def too_short(inputs):
    """A pendulum whose prior of the length excludes the true one."""
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    length = pyro.sample("length", dist.Uniform(0.3, 0.75))
    return npdr.simulate("trajectory", Pendulum(), {"mass": mass, "length": length}, inputs)


def with_idle(inputs):
    """A pendulum with a parameter that does nothing."""
    pyro.sample("idle", dist.Uniform(0.0, 1.0))
    return pendulum(inputs)


def links(inputs):
    """A pendulum of eight links, of whose masses a recording shows only the sum."""
    masses = [pyro.sample(f"link{k}", dist.Normal(TRUTH["mass"] / 8, 0.03)) for k in range(8)]
    length = pyro.sample("length", dist.Uniform(0.3, 1.7))
    return npdr.simulate("trajectory", Pendulum(), {"mass": sum(masses), "length": length}, inputs)


def _rate(state, torque, friction):
    angle, velocity = state
    mass, length = TRUTH["mass"], TRUTH["length"]
    # A steep slope in place of the jump; at these torques the pendulum never sticks for long.
    resisting = friction * np.tanh(velocity / 0.005)
    force = torque - 0.5 * mass * 9.81 * length * np.sin(angle) - resisting
    return np.array([velocity, force / (mass * length**2 / 3.0)])


def _step(state, torque, friction, size):
    first = _rate(state, torque, friction)
    second = _rate(state + 0.5 * size * first, torque, friction)
    third = _rate(state + 0.5 * size * second, torque, friction)
    fourth = _rate(state + size * third, torque, friction)
    return state + size / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
