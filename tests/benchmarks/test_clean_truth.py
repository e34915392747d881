"""The truth of the clean recordings, by another route: SciPy's integrator, and Gymnasium."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from clean_fits_environments import ENVIRONMENTS, record_environment
from clean_fits_rigs import RIG_SUBJECTS, drawn_parameters, prior_ranges, record_rig
from clean_fits_subjects import SUBJECTS, recorded
from scipy.integrate import solve_ivp

SEED = 4
GRAVITY = 9.81


def short(name, duration):
    subject = RIG_SUBJECTS[name]
    return replace(subject, rig=replace(subject.rig, duration=duration))


def pendulum(q, v, u, p):
    torque = u[0] - 0.5 * p["mass"] * GRAVITY * p["length"] * np.sin(q[0])
    return [3.0 * torque / (p["mass"] * p["length"] ** 2)]


def emps(q, v, u, p):
    return [(35.15065 * u[0] - p["viscous_friction"] * v[0]) / p["mass"]]


def cart_pole(q, v, u, p):
    moment = 0.5 * p["pole_mass"] * p["pole_length"]
    cross = moment * np.cos(q[1])
    masses = [
        [p["cart_mass"] + p["pole_mass"], cross],
        [cross, p["pole_mass"] * p["pole_length"] ** 2 / 3.0],
    ]
    forces = [
        u[0] - p["cart_damping"] * v[0] + moment * np.sin(q[1]) * v[1] ** 2,
        -p["pole_damping"] * v[1] - moment * GRAVITY * np.sin(q[1]),
    ]
    return np.linalg.solve(masses, forces)


def furuta(q, v, u, p):
    c1 = 0.25 * p["pole_mass"] * p["pole_length"] ** 2
    c0 = (p["arm_mass"] / 12.0 + p["pole_mass"]) * p["arm_length"] ** 2
    c2 = 0.5 * p["pole_mass"] * p["pole_length"] * p["arm_length"]
    cross = c2 * np.cos(q[1])
    masses = [[c0 + c1 * np.sin(q[1]) ** 2, cross], [cross, c1 / 0.75]]
    drive = p["motor_constant"] * (u[0] - p["motor_constant"] * v[0]) / p["motor_resistance"]
    weight = 0.5 * p["pole_mass"] * p["pole_length"] * p["gravity"]
    forces = [
        drive
        - p["arm_damping"] * v[0]
        - c1 * np.sin(2.0 * q[1]) * v[0] * v[1]
        + c2 * np.sin(q[1]) * v[1] ** 2,
        0.5 * c1 * np.sin(2.0 * q[1]) * v[0] ** 2
        - weight * np.sin(q[1])
        - p["pole_damping"] * v[1],
    ]
    return np.linalg.solve(masses, forces)


@pytest.mark.parametrize("equation", [pendulum, emps, cart_pole, furuta])
def test_the_truth_is_what_scipy_integrates(equation):
    subject = short(equation.__name__, 0.5)
    parameters = drawn_parameters(subject, SEED)
    recording = record_rig(subject, parameters, seed=SEED, is_noisy=False)
    states, actions = recording.true_states[1], recording.rollouts.actions[1]
    assert np.array_equal(states, recording.rollouts.readings[1])  # the noise is off
    num_joints, state = states.shape[1] // 2, states[0]
    for step in range(len(actions)):

        def rates(_, x, command=actions[step]):
            q, v = x[:num_joints], x[num_joints:]
            return [*v, *equation(q, v, command, parameters)]

        span = (0.0, subject.rig.time_step)
        found = solve_ivp(rates, span, state, method="DOP853", rtol=1e-10, atol=1e-12)
        state = found.y[:, -1]
        # Of half a second, which no motion here makes unstable.
        assert np.abs(state - states[step + 1]).max() < 1e-6
    assert np.abs(state - states[0]).max() > 0.01  # it has moved


@pytest.mark.parametrize("name", RIG_SUBJECTS)
def test_the_truth_has_converged(name):
    """Half the step changes no reading by a hundredth of its noise."""
    subject = short(name, 1.0)
    parameters = drawn_parameters(subject, SEED)
    fine, coarse = (
        record_rig(subject, parameters, seed=SEED, is_noisy=False, substeps=substeps).true_states
        for substeps in (2 * subject.rig.substeps, subject.rig.substeps)
    )
    noise = subject.rig.measurement
    sizes = np.array(noise.counts + noise.velocity_noise)
    assert np.abs((fine - coarse) / sizes).max() < 0.01
    assert subject.rig.time_step / subject.rig.substeps <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", RIG_SUBJECTS)
def test_the_motion_is_within_limits_and_the_noise_small(name):
    subject = RIG_SUBJECTS[name]
    parameters = drawn_parameters(subject, SEED)
    assert all(low <= parameters[k] <= high for k, (low, high) in prior_ranges(name).items())
    recording = record_rig(subject, parameters, seed=SEED)
    assert (np.abs(recording.true_states).max((0, 1)) <= np.array(subject.limits)).all()
    error = np.stack(recording.rollouts.readings) - recording.true_states
    assert (error.std((0, 1)) > 0.0).all()
    # Motion of ten standard deviations of the noise is what a user would call clean.
    assert (error.std((0, 1)) < 0.1 * recording.true_states.std((0, 1))).all()


@pytest.mark.parametrize(
    ("name", "environment", "attributes"),
    [
        ("gymnasium_pendulum", "Pendulum-v1", {"m": "mass", "l": "length"}),
        ("gymnasium_mountain_car", "MountainCarContinuous-v0", {"power": "power"}),
    ],
)
def test_the_recurrences_are_gymnasiums(name, environment, attributes):
    parameters = {k: 0.3 * low + 0.7 * high for k, (low, high) in ENVIRONMENTS[name].prior.items()}
    rollouts = record_environment(name, parameters, seed=SEED, is_noisy=False)
    made = gymnasium.make(environment, disable_env_checker=True).unwrapped
    for readings, actions in zip(rollouts.readings, rollouts.actions, strict=True):
        made.reset(seed=0)
        for attribute, parameter in attributes.items():
            setattr(made, attribute, parameters[parameter])
        made.state = readings[0].copy()
        found = [readings[0]]
        for action in actions:
            made.step(action)
            found.append(np.array(made.state, dtype=float))
        # The car keeps 32-bit numbers, of which the last digit grows over 120 steps.
        assert np.abs(np.array(found) - readings).max() < 1e-5


@pytest.mark.parametrize(
    "subject", ["pendulum", "given_pendulum", "gymnasium_pendulum", "quick_start", "throw"]
)
def test_the_seed_decides_all(subject):
    assert subject in SUBJECTS
    made, again, other = (recorded(subject, seed) for seed in (SEED, SEED, SEED + 1))
    assert set(made.truth) == set(made.prior)
    assert made == again
    assert made != other
    if made.rollouts is not None:
        assert len(made.rollouts) == 4
