"""Problems of the data that show without simulating."""

import numpy as np

import npdr_ppl as npdr
from npdr_ppl.discovery.data_checks import recording_problems
from npdr_ppl.models.pendulum import Pendulum

STEP = 0.01


def recording(angle, velocity):
    readings = np.stack((angle, velocity), axis=1)
    return npdr.Rollouts.from_arrays(
        [readings],
        [np.zeros((len(readings) - 1, 1))],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=STEP,
    )


def swing(num_steps):
    time = STEP * np.arange(num_steps)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, (2, num_steps))
    return np.sin(3.0 * time) + noise[0], 3.0 * np.cos(3.0 * time) + 3.0 * noise[1]


def test_samples_that_were_lost_are_noticed():
    angle, velocity = (np.delete(values, slice(200, 230)) for values in swing(600))
    (problem,) = recording_problems(Pendulum().sensors, recording(angle, velocity))
    assert "number of gaps: 1," in problem
    assert "1.99 s" in problem


def test_a_device_that_rests_most_of_the_time_has_lost_nothing():
    angle, velocity = swing(600)
    creep = 1e-9 * np.arange(1200)
    resting = recording(
        np.concatenate((angle, angle[-1] + creep)), np.concatenate((velocity, 1e2 * creep))
    )
    assert not recording_problems(Pendulum().sensors, resting)


def test_fast_motion_before_slow_motion_is_no_gap():
    """The swing-up before seconds of slow motion, which determine the median change."""
    time = STEP * np.arange(3000)
    angle = 0.03 * time + np.exp(-np.square(time / 0.2)) * np.sin(20.0 * time)
    velocity = np.gradient(angle, STEP) + 1e-3 * np.sin(50.0 * time)
    assert not recording_problems(Pendulum().sensors, recording(angle, velocity))
