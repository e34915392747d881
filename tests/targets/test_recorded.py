"""Recorded data as a target domain."""

import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets import RecordedTarget


@pytest.fixture
def rollouts():
    generator = np.random.default_rng(0)
    return Rollouts.from_arrays(
        readings=[generator.normal(size=(steps + 1, 2)) for steps in (4, 6)],
        actions=[generator.normal(size=(steps, 1)) for steps in (4, 6)],
        rewards=[generator.normal(size=steps) for steps in (4, 6)],
        channel_names=("angle", "velocity"),
        channel_units=("rad", "rad/s"),
        action_names=("torque",),
        action_units=("N m",),
        time_step=0.01,
    )


def refuse(readings, time):
    raise AssertionError("a recorded target does not ask the controller")


def test_every_episode_has_its_recording_until_none_is_left(rollouts):
    target = RecordedTarget(rollouts)
    assert target.is_recorded and target.num_episodes == 2
    assert [(c.name, c.unit) for c in target.sensors] == [("angle", "rad"), ("velocity", "rad/s")]
    # Out of order, as a resumed run asks.
    assert target.run(refuse, 100, episode=1, seed=0) == rollouts[1]
    assert target.run(refuse, 100, episode=0, seed=0) == rollouts[0]
    with pytest.raises(DataError, match="There are 2 recorded rollouts and no episode 2"):
        target.run(refuse, 100, episode=2, seed=0)


def test_long_recordings_are_cut(rollouts):
    cut = RecordedTarget(rollouts).run(refuse, 3, episode=1, seed=0)
    assert cut.lengths == (3,)
    assert np.array_equal(cut.readings[0], rollouts.readings[1][:4])
    assert np.array_equal(cut.rewards[0], rollouts.rewards[1][:3])
