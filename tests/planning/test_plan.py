"""Plans: better than a random recording, within limits, repeatable; and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.errors import DataError
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.planning import plan_recording
from npdr_ppl.planning.causes import causes_of_run, prior_of
from npdr_ppl.planning.judging import Judge
from npdr_ppl.planning.limits import ChannelLimits, default_limits, read_limits
from tests.helpers.command_line import run_for_module

pytestmark = pytest.mark.slow

MODEL = """
from hidden_rigs.under_test import pendulum as model
"""


@pytest.fixture(scope="module")
def planned(surviving):
    return plan_recording(*surviving, rounds=8, seed=1)


def test_a_plan_separates_more_than_a_random_recording(planned):
    dry = next(p for p in planned.pairs if "presliding" in p.one + p.other)
    assert dry.before < 1.5
    assert dry.after > 1.5 * dry.random
    assert planned.to_dict()["smallest_separation"] == min(p.after for p in planned.pairs)


def test_every_cause_keeps_the_limits(planned, surviving):
    known, limits = surviving
    judge = Judge(known, limits, seed=0)
    recording = planned.recording
    played = judge.played(recording.actions[0][None], recording.readings[0][:1])
    for k, channel in enumerate(limits.channels.values()):
        assert played.readings[..., k].max() <= channel.max
        assert played.readings[..., k].min() >= channel.min
    assert np.array_equal(played.readings[0, 0], recording.readings[0][1:])


def test_a_plan_is_the_same_with_the_same_seed(planned, surviving):
    again = plan_recording(*surviving, rounds=8, seed=1)
    assert again.recording == planned.recording
    assert again.to_dict() == planned.to_dict()
    assert plan_recording(*surviving, rounds=2, seed=2).recording != planned.recording


def test_a_plan_from_the_prior_narrows_parameters(unrecorded):
    found = plan_recording(*unrecorded, rounds=5)
    assert not found.pairs
    for width in found.widths:
        assert width.after < 0.1 * width.before
    random = sum(np.log(w.random) for w in found.widths)
    assert sum(np.log(w.after) for w in found.widths) < random
    assert found.information > 5.0


def test_impossible_limits_get_a_sentence(unrecorded):
    known, limits = unrecorded
    channel = ChannelLimits(max_rate=1e-9, noise=1e-3)
    limits = replace(limits, channels=limits.channels | {"angle": channel})
    with pytest.raises(DataError, match="kept the limits"):
        plan_recording(known, limits, rounds=2)


def test_a_simulator_that_fails_is_quoted(unrecorded, monkeypatch):
    known, limits = unrecorded

    def fails(*_):
        raise npdr.NpdrError("The spring broke.")

    monkeypatch.setattr(type(known.causes[0].simulator), "simulate", fails)
    with pytest.raises(DataError, match=r"A simulation failed: The spring broke\."):
        plan_recording(known, limits, rounds=1)


def test_a_discovery_keeps_what_rebuilds_its_causes(ambiguous, surviving):
    _, folder = ambiguous
    known, _ = surviving
    record = json.loads((folder / "discovery.json").read_text())["surviving_causes"]
    assert [c.name for c in known.causes][0] == "hinge.coulomb_friction"
    assert record["version"] == 1
    assert known.causes[0].probability == pytest.approx(max(c.probability for c in known.causes))
    for cause in known.causes:
        assert (np.linalg.eigvalsh(cause.precision.numpy()) >= 1.0 - 1e-9).all()


@pytest.fixture
def fitted(tmp_path):
    """A finished fit of the zoo's pendulum, of which only the parameters matter here."""
    parameters = {
        "mass": {"mean": 1.0, "sd": 0.1, "hdi_94": [0.8, 1.2]},
        "length": {"mean": 0.9, "sd": 0.01, "hdi_94": [0.88, 0.92]},
    }
    found = {"backend": "snpe-c", "parameters": parameters, "finer_steps": 0}
    (tmp_path / "fit.json").write_text(json.dumps(found))
    return tmp_path


def test_a_plan_after_a_fit_begins_with_its_posterior(fitted):
    known = causes_of_run(fitted, pendulum)
    (cause,) = known.causes
    values = prior_of(pendulum).to_parameters(cause.z[None])
    assert [float(values[n]) for n in ("mass", "length")] == pytest.approx([1.0, 0.9])
    # The priors are uniform on (0.3, 1.7): a density of 1/1.4 against a normal one of 0.4.
    width = cause.precision.inverse().diagonal().sqrt()
    assert width[0] == pytest.approx(0.1 / 1.4 / 0.3989, rel=0.05)
    limits = read_limits(None, default_limits(cause.simulator, None))
    found = plan_recording(known, limits, rounds=2)
    for narrowed, before in zip(found.widths, width.tolist(), strict=True):
        assert narrowed.after < narrowed.before == pytest.approx(before)


def test_a_fit_of_another_model_gets_a_sentence(fitted):
    with pytest.raises(DataError, match="is a parameter of only one of model"):
        causes_of_run(fitted, make_case("emps", "null", (), seed=1).model)


def changed_run(folder, tmp_path, change):
    found = json.loads((folder / "discovery.json").read_text())
    change(found)
    (tmp_path / "discovery.json").write_text(json.dumps(found))
    return tmp_path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("surviving_causes"), "written by an older version"),
        (lambda f: f["surviving_causes"].update(version=99), "in version 99"),
        (lambda f: f["surviving_causes"].pop("noise"), "is not what npdr writes"),
        (lambda f: f["surviving_causes"].update(separations=[[0.0]]), "do not fit together"),
        (lambda f: f["surviving_causes"].update(causes=[]), "do not fit together"),
        (
            lambda f: f["surviving_causes"]["causes"][0].update(coordinates=[0.0]),
            "numbers do not fit together",
        ),
        (
            lambda f: f["surviving_causes"]["causes"][0]["parameters"].pop("mass"),
            "mass is a parameter of only one of model",
        ),
        (
            lambda f: f["surviving_causes"]["causes"][0]["effects"][0].update(effect="magic"),
            "magic",
        ),
        (lambda f: f.update(finer_steps=1000), "1000 times finer steps"),
    ],
)
def test_an_old_or_edited_run_gets_a_sentence(change, message, ambiguous, tmp_path):
    case, folder = ambiguous
    with pytest.raises(npdr.NpdrError, match=message) as raised:
        causes_of_run(changed_run(folder, tmp_path, change), case.model)
    assert "\n" not in str(raised.value)


def test_another_model_gets_a_sentence(ambiguous):
    other = make_case("emps", "null", (), seed=1).model
    with pytest.raises(npdr.NpdrError):
        causes_of_run(ambiguous[1], other)


def test_the_command_writes_commands_to_play(ambiguous, tmp_path):
    _, folder = ambiguous
    model = tmp_path / "model.py"
    model.write_text(MODEL)
    out = tmp_path / "next.csv"
    words = "plan", folder, f"{model}:model", "--out", out, "--batches", 4
    code, text, err = run_for_module(*words)
    assert code == 0, err
    assert "with the plan" in text and "hinge.presliding_friction" in text
    read = npdr.Rollouts.from_csv(out)
    assert read.action_names == ("torque",) and read.channel_names == ("angle", "velocity")
    code, _, err = run_for_module(*words)
    assert code == 2 and "exists already" in err


def test_the_command_plans_without_a_run_and_prints_json(tmp_path):
    limits = tmp_path / "limits.toml"
    limits.write_text("duration = 2.0\n[channels.angle]\nmin = -0.5\nmax = 0.5\n")
    out = tmp_path / "first.csv"
    words = "--limits", limits, "--out", out, "--batches", 4, "--json"
    code, text, err = run_for_module("plan", "pendulum", *words)
    assert code == 0, err
    found = json.loads(text)
    assert {w["name"] for w in found["widths"]} == {"mass", "length"}
    read = npdr.Rollouts.from_csv(out)
    assert read.lengths == (100,)
    assert np.abs(read.readings[0][:, 0]).max() <= 0.5


def test_the_command_prints_limits(tmp_path):
    code, text, err = run_for_module("plan", "pendulum", "--print-limits")
    assert code == 0, err
    file = tmp_path / "limits.toml"
    file.write_text(text)
    assert "[actions.torque]  # N m" in text
    code, _, err = run_for_module("plan", "pendulum", "--print-limits", "--limits", file)
    assert code == 0, err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["no_run", "pendulum"], "is no folder of a finished npdr fit or npdr discover"),
        (["one", "two", "pendulum"], "takes a run and a model"),
        (["pendulum", "--out", "next.txt"], "is no .csv file"),
        (["pendulum", "--out", "nowhere/next.csv"], "nowhere is no folder; create it first"),
        (["pendulum", "--limits", "nowhere.toml"], "nowhere.toml cannot be read"),
    ],
)
def test_a_wrong_command_gets_one_sentence(words, message):
    code, _, err = run_for_module("plan", *words)
    assert code == 2
    assert message in err and err.count("\n") == 1
