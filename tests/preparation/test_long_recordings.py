"""Of a very long recording, a fit uses segments that are spread over all of it."""

import pytest

from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation import data_options
from npdr_ppl.preparation.data_options import DataOptions
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


def test_all_segments_are_used_where_initial_states_are_taken_as_true(rollouts, few):
    options = DataOptions(segment_length=20, initial_state="estimated")
    assert options.num_segments(rollouts) == (40, 40)
    assert options.inputs(rollouts).num_segments == 40
