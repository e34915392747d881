"""The turns of angles that a log wraps are added up; other measurements are left as they are."""

from dataclasses import replace

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.notes import faults_among
from npdr_ppl.rollouts.wrapped_angles import unwrapped

STEP = 0.01
HEADING = Channel("heading", "rad")
TURN = 2.0 * np.pi


def recorded(*headings):
    return npdr.Rollouts.from_arrays(
        [heading[:, None] for heading in headings],
        [np.zeros((len(heading) - 1, 0)) for heading in headings],
        channel_names=["heading"],
        action_names=[],
        time_step=STEP,
    )


def motion(begin, num_steps=800, seed=0):
    """A heading that turns by two turns and back, with noise."""
    time = STEP * np.arange(num_steps)
    noise = np.random.default_rng(seed).normal(0.0, 2e-3, num_steps)
    return begin + 6.0 * (1.0 - np.cos(0.9 * time)) + noise


def wrapped(heading, low=-np.pi, turn=TURN):
    return low + np.mod(heading - low, turn)


@pytest.mark.parametrize("low", [-np.pi, 0.0])
def test_turns_are_added_up_in_each_rollout(low):
    true = motion(1.0), motion(-2.0, seed=1)
    found = unwrapped(recorded(*(wrapped(t, low) for t in true)), [HEADING])
    for heading, readings in zip(true, found.readings, strict=True):
        whole_turns = np.round((heading[0] - wrapped(heading, low)[0]) / TURN) * TURN
        assert readings[:, 0] == pytest.approx(heading - whole_turns)
    (note,) = found.notes
    assert "heading" in note and "whole turns" in note
    assert not faults_among(found.notes)


def test_degrees_without_a_unit_are_recognised():
    true = np.rad2deg(motion(0.0))
    found = unwrapped(recorded(wrapped(true, -180.0, 360.0)), [HEADING])
    assert found.readings[0][:, 0] == pytest.approx(true)
    assert "degrees" in found.notes[0]


def test_late_and_missing_measurements_do_not_blur_a_jump(tmp_path):
    rng = np.random.default_rng(3)
    time = STEP * np.arange(800) + rng.uniform(-0.3, 0.3, 800) * STEP
    true = 6.0 * (1.0 - np.cos(0.9 * time))
    kept = rng.random(800) > 0.1
    mapping = {"channels": {"heading": {"signal": "heading"}}}

    def read(headings):
        lines = [f"{t},{h}" for t, h in zip(time[kept], headings[kept], strict=True)]
        (tmp_path / "log.csv").write_text("\n".join(["time,heading", *lines]))
        return npdr.Rollouts.load(tmp_path / "log.csv", mapping)

    found = unwrapped(read(wrapped(true)), [HEADING])
    assert found.readings[0] == pytest.approx(read(true).readings[0], abs=1e-3)
    sampling = found.sampling(0)
    values = sampling.values[sampling.is_read[:, 0], 0]
    assert np.abs(np.diff(values)).max() < 0.5


def test_short_turns_noise_and_dropouts_do_not_hide_a_wrapped_angle():
    rng = np.random.default_rng(2)
    true = np.concatenate((np.zeros(2000), np.linspace(0.0, 4.0, 40), np.full(2000, 4.0)))
    noisy = wrapped(true) + rng.normal(0.0, 0.02, len(true))
    noisy[500:509] = 0.0
    (found,) = unwrapped(recorded(noisy), [HEADING])
    assert np.abs(np.delete(found.readings[0][:, 0] - true, slice(500, 509))).max() < 0.1


@pytest.mark.parametrize(
    "values",
    [
        3.1 * np.sign(np.sin(np.arange(800) * 0.1)),  # a rectangle
        np.random.default_rng(0).uniform(-3.0, 3.0, 800),  # nothing but noise
        np.where(np.arange(800) == 400, -2.0, 2.0) + 0.01 * np.sin(np.arange(800)),  # a spike
        motion(0.0),  # its turns are added up already
    ],
)
def test_other_measurements_are_left_as_they_are(values):
    recording = recorded(values)
    assert unwrapped(recording, [HEADING]) is recording


def test_an_angle_that_the_simulator_wraps_is_left_as_it_is():
    recording = recorded(wrapped(motion(0.0)))
    bounded = replace(HEADING, lower=-np.pi, upper=np.pi)
    assert unwrapped(recording, [bounded]) is recording
    assert unwrapped(recording, [Channel("heading", "m")]) is recording
