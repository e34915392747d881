"""Rollouts of signals: episodes, and commands that hold from one into the next."""

import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts.logs import Signal, rollouts_of


def signal(name, time, values):
    return Signal(name, np.asarray(time, dtype=float), np.asarray(values, dtype=float))


ANGLE = signal("angle", 0.1 * np.arange(300), np.sin(0.1 * np.arange(300)))


def test_an_episode_lasts_until_its_signal_changes_and_commands_hold_across_changes():
    episodes = signal("episode", [0.0, 10.0, 20.0], [0, 1, 2])
    voltage = signal("voltage", [0.0, 15.0], [1.0, 2.0])
    rollouts = rollouts_of([ANGLE], [voltage], episodes=episodes)
    assert rollouts.lengths == (99, 99, 99)
    assert [set(commands.ravel().tolist()) for commands in rollouts.actions] == [
        {1.0}, {1.0, 2.0}, {2.0},
    ]  # fmt: skip


def test_a_command_that_was_published_once_is_enough():
    rollouts = rollouts_of([ANGLE], [signal("voltage", [0.0], [3.0])])
    assert rollouts.actions[0].shape == (299, 1) and bool((rollouts.actions[0] == 3.0).all())


def test_too_little_gets_one_sentence():
    with pytest.raises(DataError, match="no signal is mapped"):
        rollouts_of([], [])
    with pytest.raises(DataError, match="angle has 1 values; at least 2 is needed"):
        rollouts_of([signal("angle", [0.0], [1.0])], [])
    with pytest.raises(DataError, match="the signal of the episodes has no values"):
        rollouts_of([ANGLE], [], episodes=signal("episode", [0.0], [np.nan]))
