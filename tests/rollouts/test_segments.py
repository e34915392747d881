from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from npdr_ppl.errors import DataError, ShapeError
from npdr_ppl.rollouts import Rollouts, segments, stitch
from npdr_ppl.rollouts.segments import default_history

torch.set_num_threads(1)


def counting(lengths, channels=2, actions=1):
    """Rollouts whose every value tells where it comes from: rollout, row and column."""
    return Rollouts.from_arrays(
        [
            1000.0 * (r + 1) + np.arange(n + 1)[:, None] + 0.1 * np.arange(channels)
            for r, n in enumerate(lengths)
        ],
        [
            -1000.0 * (r + 1) - np.arange(n)[:, None] - 0.1 * np.arange(actions)
            for r, n in enumerate(lengths)
        ],
        channel_names=[f"c{i}" for i in range(channels)],
        action_names=[f"a{i}" for i in range(actions)],
        time_step=0.1,
    )


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=4),
    segment_length=st.none() | st.integers(1, 15),
    history=st.integers(0, 5),
)
def test_every_step_is_in_exactly_one_segment(lengths, segment_length, history):
    rollouts = counting(lengths)
    inputs = rollouts.inputs(segment_length, "recorded", history=history)
    observation = rollouts.observation(inputs)
    length = segment_length or max(lengths)
    assert inputs.num_segments == sum(-(-n // (segment_length or n)) for n in lengths)
    assert inputs.num_steps == min(length, max(lengths))
    assert int(inputs.mask.sum()) == sum(lengths)
    for s in range(inputs.num_segments):
        rollout, start = int(inputs.rollout[s]), int(inputs.start[s])
        base = 1000.0 * (rollout + 1)
        assert inputs.initial_readings[s, 0] == base + start
        steps = int(inputs.mask[s].sum())
        assert inputs.mask[s, :steps].all()
        rows = torch.arange(start, start + steps, dtype=torch.float64)
        torch.testing.assert_close(inputs.actions[s, :steps, 0], -base - rows)
        torch.testing.assert_close(observation[s, :steps, 0], base + rows + 1)
        assert not inputs.actions[s, steps:].any() and not observation[s, steps:].any()
        for h in range(history):
            row = start - history + h
            assert inputs.past_actions[s, h, 0] == (-base - row if row >= 0 else 0)
    torch.testing.assert_close(rollouts.observation(segment_length), observation)
    for series, measured in zip(stitch(observation, inputs), rollouts.series(), strict=True):
        assert torch.equal(series, measured)


def test_stitching_keeps_leading_dimensions_and_picks_channels():
    rollouts = counting((5, 3), channels=3)
    inputs = rollouts.inputs(2, "recorded")
    trajectory = rollouts.observation(inputs, ["c2", "c0"]).expand(4, 6, -1, -1, -1)
    pieces = stitch(trajectory, inputs, ["c2", "c0"])
    assert [tuple(piece.shape) for piece in pieces] == [(4, 6, 5, 2), (4, 6, 3, 2)]
    for piece, measured in zip(pieces, rollouts.series(["c2", "c0"]), strict=True):
        assert torch.equal(piece[3, 5], measured)
    # The order of segments does not matter.
    order = torch.tensor([3, 1, 4, 0, 2])
    shuffled = stitch(trajectory[..., order, :, :], inputs.segments(order), ["c2", "c0"])
    assert all(torch.equal(a, b) for a, b in zip(shuffled, pieces, strict=True))


def test_stitching_refuses_what_does_not_fit():
    rollouts = counting((5,))
    inputs = rollouts.inputs(2, "recorded")
    with pytest.raises(ShapeError, match=r"ends in the shape \(3, 2, 2\), got \(3, 2, 1\)"):
        stitch(torch.zeros(3, 2, 1), inputs)
    with pytest.raises(DataError, match="speed was not recorded"):
        stitch(torch.zeros(3, 2, 1), inputs, ["speed"])


def test_observation_of_chosen_segments_and_channels():
    rollouts = counting((5, 3))
    inputs = rollouts.inputs(2, "recorded", dtype=torch.float32)
    chosen = rollouts.observation(inputs.segments([4, 1]), ["c1"])
    assert chosen.dtype == torch.float32 and tuple(chosen.shape) == (2, 2, 1)
    assert chosen[0, 0, 0] == torch.tensor(2003.1) and chosen[1, 1, 0] == torch.tensor(1004.1)
    with pytest.raises(DataError, match="c7 was not recorded; the channels are c0, c1"):
        rollouts.observation(inputs, ["c7"])
    with pytest.raises(DataError, match="other rollouts"):
        rollouts[0].observation(inputs)


def before(inputs, name, back):
    """What was measured some steps before each segment, or when its rollout began."""
    steps = (inputs.start - back).clamp_min(0)
    return 1000.0 * (inputs.rollout.double() + 1.0) + steps + 0.1 * int(name[1:])


def test_inputs_that_were_cut_moved_or_reduced_keep_the_past_of_their_rollouts():
    inputs = counting((5, 3, 7), channels=3, actions=2).inputs(2, "recorded")
    devices = replace(
        inputs,
        actions=torch.stack((inputs.actions, -inputs.actions)),
        past_actions=torch.stack((inputs.past_actions, -inputs.past_actions)),
    )
    variants = {
        "themselves": inputs,
        "chosen segments": inputs.segments([5, 0, 3]),
        "a slice": inputs.segments(slice(2, None, 2)),
        "other channels": inputs.select_channels(["c2", "c0"]),
        "both": inputs.segments([6, 2]).select_channels(["c0"]),
        "another type": inputs.to(dtype=torch.float32),
        "one of several devices": devices.element(1),
        "segments of several devices": devices.segments([4, 1]),
        "with drawn starts": inputs.with_drawn_start(torch.Size((4,))),
    }
    for what, changed in variants.items():
        for name in changed.channel_names:
            found = changed.earlier(name, torch.tensor([3, 1]))
            expected = torch.stack([before(changed, name, 3), before(changed, name, 1)])
            assert torch.equal(found, expected.to(found)), (what, name)
        goals = changed.recorded_actions[changed.rollout, changed.start].abs()
        assert torch.equal(
            goals.expand_as(changed.actions[..., 0, :]), changed.actions[..., 0, :].abs()
        ), what
    assert inputs.select_channels(["c0"]).earlier("c1", torch.tensor([1])) is None
    elsewhere = inputs.to(device="meta")
    assert elsewhere.earlier("c0", torch.tensor([3, 1])).shape == (2, inputs.num_segments)


def test_the_past_of_whole_rollouts_takes_little_memory(monkeypatch):
    # Four rollouts of five padded steps with one action and two channels.
    rollouts = counting((5, 3, 2, 1))
    for most, has_actions, has_readings in (
        (40, True, True),
        (39, True, False),
        (19, False, False),
    ):
        monkeypatch.setattr(segments, "_MOST_PAST_VALUES", most)
        inputs = rollouts.inputs(2, "recorded")
        assert (inputs.recorded_actions is not None) == has_actions
        assert (inputs.recorded_readings is not None) == has_readings


def test_the_past_of_other_channels_is_refused():
    inputs = counting((5, 3)).inputs(2, "recorded")
    with pytest.raises(ShapeError, match="recorded_readings should have shape"):
        replace(inputs, recorded_readings=inputs.recorded_readings[..., :1])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"segment_length": 0}, "at least one step"),
        ({"history": -1}, "cannot be negative"),
        (
            {"initial_state": "guessed"},
            "one of .*, 'uncertain', not 'guessed'",
        ),
    ],
)
def test_wrong_arguments(small, arguments, sentence):
    with pytest.raises(DataError, match=sentence):
        small.inputs(**arguments)


def test_estimated_states_come_with_rates():
    time = 0.01 * np.arange(201)
    rollouts = Rollouts.from_arrays(
        [np.sin(5 * time)[:, None], np.cos(5 * time[:120])[:, None]],
        channel_names=("angle",),
        time_step=0.01,
    )
    inputs = rollouts.inputs(50)
    assert inputs.initial_rates is not None
    at = 0.01 * inputs.start.double()
    exact = torch.where(inputs.rollout == 0, 5 * torch.cos(5 * at), -5 * torch.sin(5 * at))
    torch.testing.assert_close(inputs.initial_rates[:, 0], exact, atol=2e-2, rtol=0)
    torch.testing.assert_close(inputs.initial_values, inputs.initial_readings, atol=1e-4, rtol=0)
    assert inputs.is_zero is not None
    is_first = inputs.start == 0
    at_zero, at_rest = inputs.is_zero[..., 0].unbind(-1)
    assert torch.equal(at_zero, is_first & (inputs.rollout == 0))
    assert torch.equal(at_rest, is_first & (inputs.rollout == 1))
    recorded = rollouts.inputs(50, "recorded")
    assert recorded.initial_rates is None and recorded.is_zero is not None
    assert torch.equal(recorded.is_zero[..., 0, 0], at_zero)
    assert torch.equal(recorded.initial_values, recorded.initial_readings)


def test_a_joint_that_never_moves_begins_at_rest():
    time = 0.01 * np.arange(201)
    still = np.full_like(time, 0.3)
    rollouts = Rollouts.from_arrays(
        [np.stack((np.sin(5 * time), still), axis=-1)],
        channel_names=("moving", "still"),
        time_step=0.01,
    )
    assert rollouts.inputs(50).is_zero[0].tolist() == [[True, False], [False, True]]


@pytest.mark.parametrize(
    ("time_step", "num_segments", "num_actions", "wanted"),
    [
        (0.002, 100, 1, 2500),  # five seconds
        (0.02, 100, 6, 250),
        (0.001, 600, 7, (1 << 22) // 4200),  # what fits into 32 MiB
        (1.0, 3, 1, 64),
        (0.001, 1_000_000, 7, 64),
    ],
)
def test_past_commands_last_five_seconds_or_take_little_memory(
    time_step, num_segments, num_actions, wanted
):
    assert default_history(time_step, num_segments, num_actions) == wanted
