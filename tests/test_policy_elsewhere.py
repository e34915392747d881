"""The example that trains a policy outside of the package on what a run exported."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the extra gymnasium is not installed")
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "policy_elsewhere.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("policy_elsewhere", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["policy_elsewhere"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["policy_elsewhere"]


def test_the_rig_is_the_robots_file_where_nothing_is_hidden(example, tmp_path):
    (tmp_path / "robot.xml").write_text(example.ROBOT)
    rig = example.HiddenRig()
    rig.load, rig.friction, rig.delay = 0.12, 0.0, 0.0
    env = example.environment(tmp_path)
    env.reset(seed=0)
    policy = example.policy_of(np.array([0.1, 0.5, 0.02]))
    moved = rig.run(lambda _, q, v: policy(q, v), 100)
    q = v = 0.0
    steps = []
    for _ in moved[1:]:
        (q, v), *_ = env.step(np.array([np.clip(policy(q, v), -1.0, 1.0)]))
        steps.append((q, v))
    # Another integrator with other steps; the motion has 1.5 rad and 9 rad/s.
    angle, velocity = np.abs(np.array(steps) - moved[1:, :2]).max(axis=0)
    assert angle < 0.02 and velocity < 0.2


def test_each_hidden_cause_changes_the_motion(example):
    policy = example.policy_of(np.array([0.1, 0.5, 0.02]))
    moved = example.HiddenRig().run(lambda _, q, v: policy(q, v), 100)
    for name, nominal in {"load": 0.12, "friction": 0.0, "delay": 0.0}.items():
        other = example.HiddenRig()
        setattr(other, name, nominal)
        change = other.run(lambda _, q, v: policy(q, v), 100) - moved
        assert np.abs(change[:, 0]).max() > 0.03, name


def test_the_search_improves_a_policy_in_the_robots_file(example, tmp_path):
    (tmp_path / "robot.xml").write_text(example.ROBOT)
    env = example.environment(tmp_path)
    gains = example.train(env, iterations=4, candidates=8, num_steps=100)
    before, after = (
        example.episode(env, example.policy_of(row), 100, 0) for row in (np.zeros(3), gains)
    )
    assert after > 0.4 * before  # returns are negative


@pytest.mark.slow
def test_a_policy_trained_on_exported_draws_works_better_on_the_hidden_rig(example, tmp_path):
    folder = tmp_path / "elsewhere"
    effects = "hinge_torque.coulomb_friction,motor.input_delay"
    wrapper = example.identify(folder, "--candidates", effects, num_steps=120)
    reached = example.compare(folder, wrapper, iterations=8, candidates=12, num_steps=200)
    print(reached)
    none, file, exported = reached.values()
    assert exported[0] > 0.1 * none[0]
    assert exported[0] > file[0]
    assert exported[1] < 0.1  # rad
