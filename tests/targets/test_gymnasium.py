"""Gymnasium environments as target domains."""

import doctest
import importlib
import sys

import numpy as np
import pytest

from npdr_ppl.errors import DependencyError, ModelError, ShapeError
from npdr_ppl.language.channels import Channel
from npdr_ppl.targets import GymnasiumTarget, TargetError

NEEDED = "needs the extra `gymnasium`"


@pytest.fixture
def spring():
    """A mass on a spring, pushed by ±2 N; it ends beyond 3 m and is paid by its position."""
    gymnasium = pytest.importorskip("gymnasium", reason=NEEDED)

    class Spring(gymnasium.Env):
        dt = 0.1
        observation_space = gymnasium.spaces.Box(-10.0, 10.0, (2,))
        action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.state = self.np_random.uniform(-0.1, 0.1, 2).astype(np.float32)
            return self.state, {}

        def step(self, action):
            assert self.action_space.contains(action)
            self.state += np.float32(self.dt) * np.array([self.state[1], action[0]], np.float32)
            return self.state, float(self.state[0]), bool(self.state[0] > 3.0), False, {}

    return Spring()


def push(readings, time):
    return np.array([5.0])


def test_an_episode_is_recorded_with_its_rewards_until_it_terminates(spring):
    recorded = GymnasiumTarget(spring).run(push, 200, seed=3)
    (readings,), (actions,), (rewards,) = recorded.readings, recorded.actions, recorded.rewards
    assert len(actions) < 200
    assert readings[-1, 0] > 3.0 >= readings[-2, 0]
    assert np.all(actions == 2.0)
    assert np.array_equal(rewards, readings[1:, 0])
    assert recorded.time_step == 0.1
    # The environment moves its observation in place, so each row has to be a copy.
    np.testing.assert_allclose(np.diff(readings[:, 1]), 0.2, rtol=1e-4)


def test_the_seed_repeats_an_episode(spring):
    target = GymnasiumTarget(spring)
    assert target.run(push, 20, seed=3) == target.run(push, 20, seed=3)
    assert target.run(push, 20, seed=3) != target.run(push, 20, seed=4)


def test_sensors_may_be_computed_and_named(spring):
    target = GymnasiumTarget(
        spring,
        sensors=(Channel("energy", "J"),),
        actions=(Channel("force", "N"),),
        read=lambda observation: observation @ observation[:, None],
        time_step=0.2,
    )
    recorded = target.run(push, 5, seed=0)
    assert recorded.channel_names == ("energy",)
    assert recorded.action_units == ("N",)
    assert recorded.time_step == 0.2
    assert target.actions[0].upper == 2.0


def test_registered_environments_are_made_by_their_id():
    pytest.importorskip("gymnasium", reason=NEEDED)
    target = GymnasiumTarget("Pendulum-v1")
    assert target.name == "Pendulum-v1"
    assert target.run(push, 10, seed=0).lengths == (10,)
    target.close()
    with pytest.raises(ModelError, match="cannot make 'Pendulo-v1'"):
        GymnasiumTarget("Pendulo-v1")


def test_spaces_that_do_not_do_are_explained(spring):
    with pytest.raises(ModelError, match="command real numbers"):
        GymnasiumTarget("CartPole-v1")
    with pytest.raises(ModelError, match="needs sensors"):
        GymnasiumTarget(spring, read=lambda observation: observation)
    with pytest.raises(ModelError, match="1 actions, but 2 were named"):
        GymnasiumTarget(spring, actions=(Channel("x", "N"), Channel("y", "N")))
    spring.dt = None
    with pytest.raises(ModelError, match="give time_step"):
        GymnasiumTarget(spring)


def test_bad_commands_are_refused(spring):
    target = GymnasiumTarget(spring)
    with pytest.raises(ShapeError, match="1 commands per step"):
        target.run(lambda readings, time: np.zeros(2), 5, seed=0)
    with pytest.raises(TargetError, match="commanded nan"):
        target.run(lambda readings, time: np.array([np.nan]), 5, seed=0)


def test_absent_gymnasium_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(DependencyError, match=r"npdr-ppl\[gymnasium\]"):
        GymnasiumTarget("Pendulum-v1")


def test_the_example_runs():
    pytest.importorskip("gymnasium", reason=NEEDED)
    found = doctest.testmod(importlib.import_module("npdr_ppl.targets.gymnasium"))
    assert found.attempted > 0
    assert found.failed == 0
