"""Furuta pendulums as target domains."""

import numpy as np
import pytest
import torch

from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.models import targets
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.targets import TargetDomain, TargetError


def wave(readings, time):
    return np.array([6.0 * np.sin(9.0 * time) - 2.0 * readings[0]])


@pytest.mark.parametrize("name", targets())
def test_presets_run_and_repeat_by_their_seed(name):
    target = targets()[name].make()
    assert isinstance(target, TargetDomain)
    assert target.name == name
    assert not target.is_recorded
    recorded = target.run(wave, 50, seed=1)
    recorded.check(Furuta.sensors, Furuta.actions)
    assert recorded.time_step == 0.002
    assert recorded.rewards is None
    assert np.abs(recorded.actions[0]).max() <= 4.0
    assert recorded == targets()[name].make().run(wave, 50, seed=1)
    assert recorded != target.run(wave, 50, seed=2)


def test_episodes_start_near_hanging():
    target = furuta_target("furuta-easy")
    starts = np.array([target.run(wave, 1, seed=seed).readings[0][0] for seed in range(30)])
    bounds = np.radians([2.0, 1.0, 0.5, 0.5])
    count = np.pi / 2048
    assert np.all(np.abs(starts) <= bounds + count)
    assert np.all(starts.std(axis=0) > bounds / 4.0)


def test_leaving_the_bounds_stops_the_rig():
    recorded = furuta_target("furuta-easy").run(
        lambda readings, time: np.array([4.0]), 2500, seed=0
    )
    assert recorded.lengths[0] < 1000
    assert abs(recorded.readings[0][-1, 0]) > Furuta.sensors[0].upper - 0.01


def test_random_rigs_differ_by_their_number():
    episodes = [furuta_target(f"furuta-random-{n}").run(wave, 100, seed=0) for n in (0, 1, 12)]
    assert episodes[0] != episodes[1] != episodes[2]


def test_parameters_are_hidden():
    target = furuta_target("furuta-hard")
    public = {name for name in dir(target) if not name.startswith("_")}
    assert public == {name for name in dir(TargetDomain) if not name.startswith("_")} | {
        "name",
        "sensors",
        "actions",
        "time_step",
    }
    assert "0.068" not in repr(target)


@pytest.mark.parametrize("command", [0.3, np.float64(0.3), np.array([0.3]), torch.tensor([0.3])])
def test_commands_may_be_numbers_or_arrays(command):
    recorded = furuta_target("furuta-easy").run(lambda readings, time: command, 5, seed=0)
    np.testing.assert_allclose(recorded.actions[0], 0.3, rtol=1e-6)


def test_bad_commands_are_refused():
    target = furuta_target("furuta-easy")
    with pytest.raises(ShapeError, match="one voltage"):
        target.run(lambda readings, time: np.zeros(2), 5, seed=0)
    with pytest.raises(TargetError, match="commanded nan V"):
        target.run(lambda readings, time: np.array([np.nan]), 5, seed=0)


def test_unknown_names_are_answered_with_a_suggestion():
    with pytest.raises(ModelError, match="did you mean 'furuta-hard'"):
        furuta_target("furuta_hard")
    with pytest.raises(ModelError, match="furuta-random-<seed>"):
        furuta_target("pendulum")
