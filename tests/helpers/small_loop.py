"""A loop small enough to run in seconds: hold a pendulum still against its weight.

The target is not made by the package: it integrates the pendulum's equation itself, with other
parameters, and writes a line for every episode after it has finished.
"""

import contextlib
import math
import os
import time
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery import DiscoveryOptions, recording_repair
from npdr_ppl.inference.registry import backend
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.loop_options import LoopOptions
from npdr_ppl.models.effects import CoulombFriction, InputDelay
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear
from npdr_ppl.policies.search_registry import policy_search
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.targets.base import TargetDomain, end_episode

NUM_STEPS = 40

TIME_TO_REST = 0.02
"""Seconds that the device takes after an episode, in which a run can be killed too."""


class HandmadePendulum(TargetDomain):
    """Heun's method at a tenth of the time step; mass 1.3 kg, length 0.8 m."""

    name = "handmade"
    sensors = Pendulum.sensors
    actions = Pendulum.actions
    time_step = Pendulum.time_step
    first_state = (0.5, 0.0)

    def __init__(self, log=None):
        self.log = log

    def run(self, controller, num_steps, *, episode=0, seed):
        rng = np.random.default_rng(seed)
        state = np.array(self.first_state) + 0.02 * rng.standard_normal(2)
        readings, actions = [state], []
        for step in range(num_steps):
            torque = self.limit(controller(state, step * self.time_step))
            for _ in range(10):
                state = _heun(state, torque[0], self.time_step / 10)
            readings.append(state)
            actions.append(torque)
        end_episode(controller, readings[-1])
        self.note(episode)
        return self.rollout(readings, actions)

    def note(self, episode):
        """Writes down that an episode is over, and takes its time."""
        if self.log is None:
            return
        with open(self.log, "a") as file:
            file.write(f"{episode}\n")
            file.flush()
            os.fsync(file.fileno())
        time.sleep(TIME_TO_REST)


def _heun(state, torque, h):
    def rate(s):
        weight = 1.3 * 9.81 * 0.4 * math.sin(s[0])
        return np.array([s[1], (torque - weight) / (1.3 * 0.8**2 / 3)])

    first = rate(state)
    return state + 0.5 * h * (first + rate(state + h * first))


class NoisyPendulum(HandmadePendulum):
    """The same in finer steps, with noisy measurements."""

    name = "noisy"
    friction = 0.0
    """Dry friction at the hinge, N m."""

    def run(self, controller, num_steps, *, episode=0, seed):
        rng = np.random.default_rng(seed)
        state = np.array([0.5, 0.0]) + 0.02 * rng.standard_normal(2)
        readings, actions = [_read(state, rng)], []
        for step in range(num_steps):
            torque = self.limit(controller(readings[-1], step * self.time_step))
            for _ in range(20):
                friction = self.friction * math.tanh(state[1] / 0.01)
                state = _heun(state, torque[0] - friction, self.time_step / 20)
            readings.append(_read(state, rng))
            actions.append(torque)
        end_episode(controller, readings[-1])
        self.note(episode)
        return self.rollout(readings, actions)


class DryPendulum(NoisyPendulum):
    """The same with dry friction, which the zoo's pendulum lacks."""

    name = "dry"
    friction = 0.6


def _read(state, rng):
    return state + np.array([1e-3, 1e-2]) * rng.standard_normal(2)


def initial_states(num_states, generator):
    return torch.tensor([0.5, 0.0]) + 0.02 * torch.randn(num_states, 2, generator=generator)


def reward(positions, velocities, commands):
    """One for standing still at 0.5 rad."""
    return torch.exp(-10.0 * (positions[0] - 0.5).square() - 0.1 * velocities[0].square())


def small_task(excitation=None):
    policy = Linear(("angle", "velocity"), ("torque",), max_gain=20.0)
    return ControlTask("hold", policy, reward, initial_states, NUM_STEPS, 30.0, excitation)


def accurate_pendulum(inputs, *, noise=None):
    """The zoo's pendulum in Runge-Kutta steps, which discovery has no reason to refine."""
    parameters = {
        "mass": pyro.sample("mass", dist.Uniform(0.3, 1.7)),
        "length": pyro.sample("length", dist.Uniform(0.3, 1.7)),
    }
    simulator = Pendulum(integrator="rk4")
    return npdr.simulate("trajectory", simulator, parameters, inputs, noise=noise)


def swinging_task(gain=0.5):
    """A task whose first policy moves the pendulum enough to tell something by.

    Args:
        gain: Torque by velocity, N m s/rad; 0.5 overcomes dry friction of 0.6 N m.
    """
    policy = Linear(("angle", "velocity"), ("torque",), max_gain=20.0)
    gains = policy.parameters.clone()
    gains[policy.names.index("torque.velocity")] = gain
    return ControlTask(
        "swing", policy.with_parameters(gains), reward, initial_states, 200, 30.0, None
    )


SMALL_DATA = DataOptions("all/10", 20, "recorded", "float64")
"""How the rollouts of a small loop are prepared."""


def small_options(**changed):
    settings = {
        "iterations": 2,
        "rounds": 2,
        "num_simulations": 100,
        "backend": backend("snpe-c", transforms=1, hidden=(16,), epochs=5, members=2),
        "search": policy_search("power", population=8, memory=4),
        "search_iterations": 2,
        "search_restarts": 0,
        "num_domains": 5,
        "num_initial_states": 2,
        "least_success": 0.0,
        "num_checked": 20,
        "num_checked_states": 2,
    }
    return LoopOptions(**{**settings, **changed})


def discovering_options(when="before inference", **changed):
    """Looks for one of two effects."""
    few = (CoulombFriction("hinge"), InputDelay("torque"))
    discovery = DiscoveryOptions(effects=few, max_effects=1)
    settings = {"iterations": 1, "discovers": when, "discovery": discovery}
    return small_options(**{**settings, **changed})


@contextlib.contextmanager
def without_remedies():
    """Tries no remedies of faults, which takes most of the time of a small run that discovers."""
    settings = recording_repair.REPAIR
    recording_repair.REPAIR = replace(settings, large_residual=1.0)
    try:
        yield
    finally:
        recording_repair.REPAIR = settings
