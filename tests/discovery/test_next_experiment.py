"""The next experiment, for alternatives that a recording does not tell apart."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.proof.next_experiment import next_experiment
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import ActuatorGain, ViscousFriction

STEP = 0.01


class Lift(npdr.ODESimulator):
    """A mass that two thrusts lift."""

    states = sensors = (npdr.Channel("z", "m"), npdr.Channel("v", "m/s", rate_of="z"))
    actions = (npdr.Channel("left", "N", 0.0, 20.0), npdr.Channel("right", "N", 0.0, 20.0))
    parameters = (npdr.Parameter("mass", "kg", 1.0),)
    joints = ("z_force",)
    ports = (
        npdr.Port("z_force", "force", "N", coordinate="m"),
        npdr.Port("left", "action", "N"),
        npdr.Port("right", "action", "N"),
    )
    time_step = STEP

    def accelerations(self, positions, velocities, actions, forces, constants):
        return ((actions[0] + actions[1] + forces[0]) / constants["mass"] - 9.81,)


def lift(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))
    return npdr.simulate("trajectory", Lift(), {"mass": mass}, inputs)


def flights(noise):
    """Returns three flights of 1 kg whose left thrust is 8 % weaker than its command."""
    rng = np.random.default_rng(0)
    readings, actions = [], []
    for _ in range(3):
        commands = 5.0 + rng.normal(0.0, 1.0, (20, 2)).repeat(10, 0)
        z, v, found = 0.0, 0.0, [0.0]
        for left, right in commands:
            for _ in range(10):
                v += (0.92 * left + right - 9.81) * STEP / 10
                z += v * STEP / 10
            found.append(z)
        readings.append(np.array(found)[:, None] + rng.normal(0.0, noise, (201, 1)))
        actions.append(commands)
    return npdr.Rollouts.from_arrays(
        readings, actions, channel_names=("z",), action_names=("left", "right"), time_step=STEP
    )


def experiment(rollouts, *effects):
    options = segment_options(rollouts)
    fitted = [fit_hypothesis(lift, rollouts, options, effects=(effect,)) for effect in effects]
    return next_experiment(fitted, rollouts, options, ())


def test_no_excitation_separates_causes_that_another_mass_makes_equal():
    rollouts = flights(noise=1e-3)
    found = experiment(rollouts, ActuatorGain("left"), ActuatorGain("right"))
    assert found.excitation is None
    assert max(found.separations.values()) < 1.0
    assert list(found.differing) == ["mass"]
    light, heavy = (found.differing["mass"][f"{side}.actuator_gain"] for side in ("left", "right"))
    assert light < heavy
    # Thrusts stay between the smallest and the greatest that were recorded.
    left = np.concatenate(rollouts.actions)[:, 0]
    assert found.least["left"] == pytest.approx(left.min())
    assert found.amplitude["left"] == pytest.approx(left.max())


def test_an_excitation_separates_causes_that_differ_under_it():
    rollouts = flights(noise=1e-4)
    found = experiment(rollouts, ActuatorGain("left"), ViscousFriction("z_force"))
    assert found.excitation is not None
    assert all(math.isfinite(value) for value in found.separations.values())
    assert found.separations[found.excitation] > 5.0
