"""Quaternions whose sign changes in a log are made continuous; other channels are left alone."""

import numpy as np
import pandas as pd
import pytest

import npdr_ppl as npdr
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts.notes import faults_among
from npdr_ppl.rollouts.quaternion_signs import continuous

STEP = 0.01
CHANNELS = [Channel(f"base_q{axis}", "1") for axis in "wxyz"]
NAMES = [channel.name for channel in CHANNELS]


def turning(num_steps=400):
    """The quaternions of a body that turns about a tilted axis."""
    half = 0.8 * np.sin(3.0 * STEP * np.arange(num_steps + 1))
    axis = np.array([0.6, 0.0, 0.8])
    return np.column_stack([np.cos(half), np.sin(half)[:, None] * axis])


def recorded(quaternions, names=NAMES):
    return npdr.Rollouts.from_arrays(
        [quaternions],
        [np.zeros((len(quaternions) - 1, 0))],
        channel_names=names,
        action_names=[],
        time_step=STEP,
    )


def flipped(quaternions):
    return np.where((np.arange(len(quaternions)) // 60 % 2)[:, None] > 0, -1.0, 1.0) * quaternions


def test_signs_that_change_together_are_undone():
    found = continuous(recorded(flipped(turning())), CHANNELS)
    assert found.readings[0] == pytest.approx(turning())
    (note,) = found.notes
    assert "base_qw … base_qz changes its sign at 6 rows" in note
    assert not faults_among(found.notes)


def test_a_dropout_does_not_hide_changes_of_sign():
    quaternions = flipped(turning())
    quaternions[100] = 0.0
    found = continuous(recorded(quaternions), CHANNELS)
    others = np.arange(len(quaternions)) != 100
    assert found.readings[0][others] == pytest.approx(turning()[others])


def test_late_measurements_do_not_blur_a_change_of_sign():
    time = STEP * (np.arange(401) + np.random.default_rng(0).uniform(-0.3, 0.3, 401))

    def read(quaternions):
        columns = dict(zip(NAMES, quaternions.T, strict=True))
        frame = pd.DataFrame({"time": time, **columns})
        mapping = {"channels": {name: {"signal": name} for name in NAMES}}
        return npdr.Rollouts.from_dataframe(frame, mapping)

    true = turning()
    found = continuous(read(flipped(true)), CHANNELS)
    assert found.readings[0] == pytest.approx(read(true).readings[0], abs=2e-3)


@pytest.mark.parametrize(
    "quaternions", [turning(), 3.0 * flipped(turning())], ids=["continuous", "no-unit-norm"]
)
def test_other_measurements_are_left_as_they_are(quaternions):
    rollouts = recorded(quaternions)
    assert continuous(rollouts, CHANNELS) is rollouts


def test_four_channels_are_needed():
    rollouts = recorded(flipped(turning())[:, :3], NAMES[:3])
    assert continuous(rollouts, CHANNELS[:3]) is rollouts
