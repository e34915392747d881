import pickle
import shutil
import sys
import types

import joblib
import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts

NAMES = {
    "theta": "arm_angle",
    "alpha": "pole_angle",
    "theta_dot": "arm_velocity",
    "alpha_dot": "pole_velocity",
    "V": "voltage",
}


def test_an_original_recording(shared):
    """The same episode was exported to CSV with nine digits."""
    rollouts = Rollouts.from_simurlacra(shared / "quanser_qube" / "original_rollout.pkl", NAMES)
    csv = Rollouts.load(shared / "quanser_qube" / "swing_up_500hz_5s.csv")[0]
    assert rollouts.channel_names == csv.channel_names
    assert rollouts.action_names == csv.action_names
    assert rollouts.time_step == csv.time_step == 0.002
    np.testing.assert_allclose(rollouts.readings[0], csv.readings[0], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(rollouts.actions[0], csv.actions[0], rtol=1e-8, atol=1e-12)
    assert rollouts.rewards is not None
    assert rollouts.rewards[0].sum() == pytest.approx(1017, abs=1)
    again = Rollouts.from_simurlacra(shared / "quanser_qube" / "original_rollout.pkl")
    assert again.channel_names == tuple(NAMES)[:4]


def test_truncations_of_the_original(shared, tmp_path):
    data = (shared / "quanser_qube" / "original_rollout.pkl").read_bytes()
    path = tmp_path / "cut.pkl"
    for end in np.linspace(0, len(data) - 1, 40).astype(int):
        path.write_bytes(data[:end])
        with pytest.raises(DataError, match="cut.pkl: "):
            Rollouts.from_simurlacra(path)


@pytest.fixture
def step_sequence(monkeypatch):
    """A class that pickles under the name of SimuRLacra's."""
    for name in ("pyrado", "pyrado.sampling", "pyrado.sampling.step_sequence"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    cls = type("StepSequence", (), {"__module__": "pyrado.sampling.step_sequence"})
    sys.modules["pyrado.sampling.step_sequence"].StepSequence = cls  # type: ignore[attr-defined]

    def make(**fields):
        instance = cls()
        instance.__dict__.update(fields)
        return instance

    return make


def episode(steps=5, **changes):
    rng = np.random.default_rng(steps)
    return {
        "observations": rng.normal(size=(steps + 1, 2)),
        "actions": rng.normal(size=(steps, 1)),
        "rewards": rng.normal(size=steps),
        "time": 0.01 * np.arange(steps + 1),
    } | changes


def test_lists_of_rollouts_without_states_or_labels(step_sequence, tmp_path):
    first, second = episode(5), episode(3)
    joblib.dump([step_sequence(**first), step_sequence(**second)], tmp_path / "x.pkl")
    rollouts = Rollouts.from_simurlacra(tmp_path / "x.pkl")
    assert rollouts.lengths == (5, 3)
    assert rollouts.channel_names == ("observation_0", "observation_1")
    assert rollouts.action_names == ("action_0",)
    np.testing.assert_array_equal(rollouts.readings[1], second["observations"])


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"actions": None}, "no numbers called actions"),
        ({"time": np.array(["x"] * 6, dtype=object)}, "no numbers called time"),
        ({"actions": np.zeros((5, 1, 1))}, "actions has 3 dimensions"),
        ({"actions": np.zeros((4, 1))}, "actions of rollout 0 should have shape"),
        ({"_rollout_bounds": np.array([0, 2, 5])}, "joined end to end"),
        ({"observations": np.full((6, 2), np.nan)}, "not a finite number"),
    ],
)
def test_wrong_rollouts(changes, sentence, step_sequence, tmp_path):
    joblib.dump(step_sequence(**episode(**changes)), tmp_path / "x.pkl")
    with pytest.raises(DataError, match=sentence):
        Rollouts.from_simurlacra(tmp_path / "x.pkl")


def test_other_files(shared, tmp_path):
    (tmp_path / "x.pkl").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(DataError, match="holds no SimuRLacra rollout"):
        Rollouts.from_simurlacra(tmp_path / "x.pkl")
    shutil.copy(shared / "quanser_qube" / "swing_up_500hz_5s.csv", tmp_path / "x.pkl")
    with pytest.raises(DataError, match="x.pkl: the pickle"):
        Rollouts.from_simurlacra(tmp_path / "x.pkl")
    with pytest.raises(DataError, match="cannot be opened"):
        Rollouts.from_simurlacra(tmp_path / "y.pkl")
