"""Of a very long recording, a fit uses segments that are spread over all of it."""

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation import data_options
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.preparation_summary import PreparationSummary
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import swinging


@pytest.fixture
def rollouts():
    return swinging(rollouts=2, steps=400)


@pytest.fixture
def few(monkeypatch):
    """At most ten segments of 20 steps and two channels."""
    monkeypatch.setattr(data_options, "MOST_READINGS", 10 * 20 * 2)


def test_a_short_recording_is_used_as_a_whole(rollouts):
    options = DataOptions(segment_length=20)
    assert options.num_segments(rollouts) == (40, 40)
    assert options.inputs(rollouts).num_segments == 40


def test_a_long_recording_is_used_in_part(rollouts, few):
    options = DataOptions(segment_length=20)
    assert options.num_segments(rollouts) == (10, 40)
    chosen = options.inputs(rollouts)
    places = list(zip(chosen.rollout.tolist(), chosen.start.tolist(), strict=True))
    assert len(set(places)) == 10
    part, whole = (
        SegmentModel(pendulum, rollouts, options, is_complete=value) for value in (False, True)
    )
    assert part.inputs.num_segments == 10 and whole.inputs.num_segments == 40
    rows = [rollout * 20 + start // 20 for rollout, start in places]
    assert [row // 4 for row in rows] == list(range(10))  # one of each tenth of the recording
    assert len({row % 4 for row in rows}) > 1  # not at equal distances
    assert (part.observed == whole.observed[rows]).all()


def test_of_a_recording_that_mostly_rests_the_motion_is_used(few):
    time = 0.02 * np.arange(801)
    phase = np.maximum(0.0, time % 1.6 - 1.2)  # rests for three quarters of each tenth
    angle = np.sin(2.0 * np.pi * phase / 0.4) + np.random.default_rng(0).normal(0.0, 1e-4, 801)
    angle[30] = 5.0  # a wrong reading is no motion
    resting = npdr.Rollouts.from_arrays(
        [np.stack([angle, np.gradient(angle, 0.02)], 1)], [np.zeros((800, 1))],
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=0.02,
    )  # fmt: skip
    index = DataOptions(segment_length=20).used_segments(resting)
    assert index.tolist() == [4 * part + 3 for part in range(10)]


def test_all_segments_are_used_where_initial_states_are_taken_as_true(rollouts, few):
    options = DataOptions(segment_length=20, initial_state="estimated")
    assert options.num_segments(rollouts) == (40, 40)
    assert options.inputs(rollouts).num_segments == 40


def test_the_sentence_says_by_what_segments_are_chosen(rollouts, few):
    summary = PreparationSummary(rollouts, DataOptions(segment_length=20), None, False, None)
    assert summary.sentence().startswith(
        "Prepared: 10 of 40 segments of 20 steps (0.4 s), one from each of 10 equal parts of the "
        "recording, moving ones preferred, "
    )
