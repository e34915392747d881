import re
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts


def arrays(lengths=(3,), channels=1, actions=1):
    readings = [np.zeros((n + 1, channels)) + np.arange(n + 1)[:, None] for n in lengths]
    return readings, [np.ones((n, actions)) for n in lengths]


def make(lengths=(3,), **changes):
    readings, actions = arrays(lengths)
    options = {"channel_names": ("x",), "action_names": ("u",), "time_step": 0.1} | changes
    return Rollouts.from_arrays(
        options.pop("readings", readings), options.pop("actions", actions), **options
    )


def test_arrays_are_copied_and_read_only():
    readings, actions = arrays()
    rollouts = make(readings=readings, actions=actions)
    readings[0][0] = 99
    assert rollouts.readings[0][0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        rollouts.readings[0][0] = 1
    with pytest.raises(FrozenInstanceError):
        rollouts.time_step = 1.0


def test_stacked_pads_with_zeros_and_masks(small):
    readings, actions, mask = small.stacked()
    assert readings.shape == (3, 8, 2) and actions.shape == (3, 7, 1) and mask.shape == (3, 7)
    assert mask.sum(1).tolist() == list(small.lengths) == [7, 4, 5]
    assert not readings[1, 5:].any() and not actions[1, 4:].any()
    np.testing.assert_array_equal(readings[2, :6], small.readings[2])


def test_tensors_and_stacks_are_accepted():
    rollouts = Rollouts.from_arrays(
        torch.zeros(4, 6, 2, requires_grad=True), channel_names=("x", "y"), time_step=0.5
    )
    assert len(rollouts) == 4 and rollouts.lengths == (5,) * 4 and rollouts.action_names == ()
    assert rollouts.actions[0].shape == (5, 0)


@pytest.mark.parametrize("index", [1, -2, [1], slice(1, 2), np.array([False, True, False])])
def test_subset(small, index):
    part = small[index]
    assert len(part) == 1
    np.testing.assert_array_equal(part.readings[0], small.readings[1])
    np.testing.assert_array_equal(part.rewards[0], small.rewards[1])


def test_iteration_and_wrong_indices(small):
    assert [part.lengths[0] for part in small] == [7, 4, 5]
    with pytest.raises(IndexError, match="no rollout 3"):
        small[3]
    with pytest.raises(IndexError):
        small[[0, 5]]
    with pytest.raises(DataError, match="no rollout was chosen"):
        small[[]]
    with pytest.raises(DataError, match="mask over 3"):
        small[np.array([True])]
    with pytest.raises(DataError, match="integers"):
        small[[0.5]]


def test_split_by_indices(small):
    train, test = small.split(train=[0, 2], test=[1])
    assert train.lengths == (7, 5) and test.lengths == (4,)
    assert small.split([0, 2]) == (train, test)
    with pytest.raises(DataError, match="rollout 2 is on both sides"):
        small.split([0, -1], [2])


@pytest.mark.parametrize("fraction", [0.01, 0.5, 0.99])
def test_fractional_split_is_a_partition_and_repeats(small, fraction):
    train, test = small.split(fraction, seed=3)
    assert sorted((*train.lengths, *test.lengths)) == [4, 5, 7]
    assert small.split(fraction, seed=3) == (train, test)
    assert small.split(fraction)[0] == small[: len(train)]


def test_fractional_split_refuses(small):
    for bad in (0.0, 1.0, 2, -0.5):
        with pytest.raises(DataError, match="fractional split"):
            small.split(bad)
    with pytest.raises(DataError, match="two rollouts"):
        small[0].split(0.5)


def test_concatenate(small):
    assert small[0].concatenate(small[1], small[2]) == small
    with pytest.raises(DataError, match="channel_names differ"):
        small.concatenate(small.select(["rate"]))
    other = Rollouts.from_arrays(
        small.readings,
        small.actions,
        channel_names=small.channel_names,
        action_names=small.action_names,
        channel_units=small.channel_units,
        action_units=small.action_units,
        time_step=0.01,
    )
    both = small.concatenate(other)
    assert both.time_step == 0.01 and len(both) == 2 * len(small)
    assert both.samplings[0].is_read.mean() < 0.6 and both.samplings[-1].is_read.all()


def test_select_orders_channels(small):
    chosen = small.select(["rate", "angle"])
    assert chosen.channel_names == ("rate", "angle") and chosen.channel_units == ("rad/s", "rad")
    np.testing.assert_array_equal(chosen.readings[1], small.readings[1][:, ::-1])
    with pytest.raises(DataError, match="speed was not recorded; the channels are angle, rate"):
        small.select(["speed"])


def test_repr_tells_what_there_is(small):
    assert repr(small) == (
        "Rollouts(3 × 4–7 steps of 0.02 s; channels angle [rad], rate [rad/s]; "
        "actions torque [N m]; rewards)"
    )


def test_equality_is_exact(small):
    assert small == small[:]
    readings = [values.copy() for values in small.readings]
    readings[1][2, 0] = np.nextafter(readings[1][2, 0], 9)
    assert small != Rollouts.from_arrays(
        readings,
        small.actions,
        channel_names=small.channel_names,
        action_names=small.action_names,
        time_step=small.time_step,
        rewards=small.rewards,
        channel_units=small.channel_units,
        action_units=small.action_units,
    )
    assert small != "rollouts"


def bad_value(value):
    readings = arrays()[0]
    readings[0][2, 0] = value
    return {"readings": readings}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (bad_value(np.nan), "x is nan at step 2 of rollout 0"),
        (bad_value(-np.inf), "x is -inf at step 2 of rollout 0"),
        (bad_value(1e200), "plausible size"),
        ({"actions": [np.full((3, 1), np.nan)]}, "u is nan at step 0"),
        ({"actions": [np.ones((4, 1))]}, r"actions of rollout 0 should have shape \(3, 1\)"),
        ({"actions": [np.ones((3, 1))] * 2}, "1 rollouts of readings, but 2 of actions"),
        ({"readings": [np.zeros((4, 2))]}, r"readings of rollout 0 should have shape \(4, 1\)"),
        ({"readings": [np.zeros((1, 1))], "actions": [np.ones((0, 1))]}, "at least two"),
        ({"readings": [], "actions": []}, "no rollouts"),
        ({"readings": 3.0}, "readings should be one array of numbers per rollout"),
        ({"readings": [["a", "b"]]}, "readings should be one array of numbers per rollout"),
        ({"rewards": [np.zeros(4)]}, r"rewards of rollout 0 should have shape \(3,\)"),
        ({"time_step": 0.0}, "must be positive"),
        ({"time_step": np.nan}, "must be positive"),
        ({"time_step": None}, "give a time step or time stamps"),
        ({"time": [np.array([0, 0.1, 0.3, 0.4])]}, "resample"),
        ({"time": [np.array([0, 0.1, 0.1, 0.2])]}, "must increase"),
        ({"time": [np.array([0, 0.2, 0.4, 0.6])]}, "said to be"),
        ({"time": [np.array([0, np.nan, 0.4, 0.6])]}, "time is nan"),
        ({"channel_names": ("u",)}, "column 'u' appears twice"),
        ({"channel_names": ("",)}, "column 1 has no name"),
        ({"channel_names": ("a,b",)}, "no comma"),
        ({"channel_names": ("9x",)}, "begin with a letter"),
        ({"channel_names": ("time",)}, "time is a reserved name"),
        ({"channel_units": ("rad", "s")}, "channel_units has 2 entries for 1 columns"),
    ],
)
def test_wrong_data_get_one_sentence(changes, sentence):
    with pytest.raises(DataError, match=sentence) as caught:
        make(**changes)
    assert re.fullmatch(r"[^\n]+\.", str(caught.value))


def test_actions_alone_are_no_rollout():
    with pytest.raises(DataError, match="no channels"):
        Rollouts.from_arrays([np.zeros((4, 0))], channel_names=(), time_step=1.0)


def test_rollouts_of_different_rates_are_refused():
    with pytest.raises(DataError, match="give each sampling rate its own file"):
        make((3, 8), time=[0.1 * np.arange(4), 0.2 * np.arange(9)], time_step=None)


@pytest.mark.parametrize("time_step", [0.002, 1 / 3, 1e-3, 0.1, 1 / 30])
def test_time_step_is_found_exactly(time_step):
    times = [time_step * np.arange(n + 1) for n in (3, 2500)]
    assert make((3, 2500), time=times, time_step=None).time_step == time_step
    shifted = make((2500,), time=[12.5 + times[1]], time_step=None).time_step
    assert shifted == pytest.approx(time_step, rel=1e-11)


def test_rounded_time_stamps_are_constant_sampling():
    times = [np.round(np.arange(301) / 30, 3)]
    assert make((300,), time=times, time_step=None).time_step == pytest.approx(1 / 30, rel=1e-9)


def test_a_recording_without_a_usable_stretch_is_refused_in_a_sentence():
    with pytest.raises(DataError, match="no stretch of the recording is usable"):
        Rollouts((np.zeros((2, 1)),), (np.zeros((1, 0)),), ("x",), (), 1.0, stretches=((),))
