"""Plans: better than a random recording, within limits, repeatable; and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.proof.surviving_causes import VERSION
from npdr_ppl.errors import DataError
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.planning import plan_recording
from npdr_ppl.planning.causes import causes_of_run, prior_of
from npdr_ppl.planning.judging import Judge
from npdr_ppl.planning.limits import ActionLimits, ChannelLimits, default_limits, read_limits
from npdr_ppl.planning.settings import PLANNING
from npdr_ppl.planning.wider import chances_with_wider_limits, wider_limits
from tests.helpers.command_line import run_for_module

pytestmark = pytest.mark.slow

CAUSES = {"hinge.coulomb_friction", "hinge.load_dependent_friction"}

MODEL = """
from hidden_rigs.under_test import pendulum as model
"""


def plan_within_limits(*args, **options):
    """Plans without the search with wider limits, which takes most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("npdr_ppl.planning.plan.chances_with_wider_limits", lambda *_, **__: ())
        return plan_recording(*args, **options)


@pytest.fixture(scope="module")
def planned(surviving):
    return plan_within_limits(*surviving, rollouts=1, rounds=8, seed=1)


def test_a_plan_separates_more_than_a_random_recording(planned):
    (friction,) = planned.pairs
    assert {friction.one, friction.other} == CAUSES
    assert friction.before < 4.0
    added, by_chance = (d**2 - friction.before**2 for d in (friction.after, friction.random))
    assert added > 1.5 * by_chance
    assert planned.to_dict()["smallest_separation"] == min(p.after for p in planned.pairs)


def test_as_many_rollouts_are_planned_as_are_needed(surviving, planned):
    known, limits = surviving
    found = plan_within_limits(known, limits, rounds=2, seed=1)
    outlook = found.outlook
    assert outlook.planned.right >= planned.outlook.planned.right - 0.05
    assert 0.0 <= outlook.planned.wrong < 0.1
    most = round(PLANNING.most_recorded / limits.duration)
    if outlook.planned.right < PLANNING.wanted:
        assert len(found.recording) <= most
        assert outlook.needed is None or outlook.needed > most
    else:
        assert len(found.recording) == outlook.needed
    assert len(found.random) == len(found.recording)
    more = plan_within_limits(known, limits, rollouts=3, rounds=2, seed=1)
    assert len(more.recording) == 3
    assert len({commands.tobytes() for commands in more.recording.actions}) == 3
    if outlook.needed is not None and outlook.needed <= 3:
        assert more.outlook.needed == outlook.needed
    # Three rollouts show more of every pair than the first of them alone.
    one = plan_within_limits(known, limits, rollouts=1, rounds=2, seed=1)
    for pair, less in zip(more.pairs, one.pairs, strict=True):
        assert pair.after >= less.after * (1.0 - 1e-9)


def test_a_plan_that_does_not_suffice_says_what_wider_limits_would_give(surviving):
    known, limits = surviving
    # Equally likely, as if the recording so far told nothing.
    known = replace(known, causes=tuple(replace(c, probability=0.5) for c in known.causes))
    channels = {n: replace(c, noise=30.0 * c.noise) for n, c in limits.channels.items()}
    narrow = replace(limits, channels=channels, duration=0.5 * limits.duration)
    found = plan_recording(known, narrow, rollouts=1, rounds=1, seed=1)
    assert found.outlook.planned.right < PLANNING.wanted
    wider = {one.limit: one.chance for one in found.outlook.wider}
    assert set(wider) == set(wider_limits(narrow, known.causes[0].simulator))
    assert {"channels", "bandwidth"} <= set(wider)
    assert all(0.0 <= chance <= 1.0 for chance in wider.values())
    assert list(wider.values()) == sorted(wider.values(), reverse=True)
    assert found.to_dict()["outlook"]["with_twice_the"] == wider


def test_wider_limits_are_not_tried_without_the_time_for_it(surviving):
    known, limits = surviving
    # A search takes longer than its limit, because one batch is always judged.
    assert (
        chances_with_wider_limits(known, limits, 1, seed=1, time_limit=5.0, least_time=5.0) == ()
    )
    (found,), again = (
        chances_with_wider_limits(known, limits, 1, seed=1, time_limit=0.1) for _ in range(2)
    )
    assert again == (found,)
    assert found.limit in wider_limits(limits, known.causes[0].simulator)


def test_wider_limits_are_twice_as_wide_about_the_same_middle(unrecorded):
    known, limits = unrecorded
    simulator = known.causes[0].simulator
    greatest = simulator.actions[0].upper
    assert 4.0 < greatest < 5.5
    action = ActionLimits(-1.0, 3.0, max_rate=10.0, start=0.5)
    channel = ChannelLimits(-1.0, 2.0, max_rate=4.0, noise=1e-3)
    free = replace(limits, bandwidth=0.5 / limits.time_step, actions={"torque": action})
    wider = wider_limits(replace(free, channels={"angle": channel}), simulator)
    torque = wider["commands"].actions["torque"]
    assert (torque.min, torque.max, torque.max_rate, torque.start) == (-2.5, greatest, 20.0, 0.5)
    angle = wider["channels"].channels["angle"]
    assert (angle.min, angle.max, angle.max_rate, angle.noise) == (-2.5, 3.5, 8.0, 1e-3)
    # Half the sampling rate cannot be exceeded, and what has no limits cannot be wider.
    assert "bandwidth" not in wider
    assert "channels" not in wider_limits(
        replace(free, channels={"angle": ChannelLimits()}), simulator
    )
    # A motor has no more than it has, unless the recording shows that it has.
    all_of_it = {"torque": ActionLimits(-greatest, greatest)}
    assert "commands" not in wider_limits(replace(free, actions=all_of_it), simulator)
    more = {"torque": ActionLimits(-6.0, 6.0, max_rate=10.0)}
    found = wider_limits(replace(free, actions=more), simulator)["commands"].actions["torque"]
    assert (found.min, found.max, found.max_rate) == (-6.0, 6.0, 20.0)


@pytest.mark.parametrize("number", [0, 61])
def test_a_wrong_number_of_rollouts_gets_a_sentence(number, unrecorded):
    with pytest.raises(DataError, match=f"between 1 and 60 rollouts, not {number}"):
        plan_recording(*unrecorded, rollouts=number)


def test_several_rollouts_narrow_parameters_more(unrecorded):
    found = [plan_recording(*unrecorded, rollouts=n, rounds=3) for n in (1, 3)]
    assert [len(plan.recording) for plan in found] == [1, 3]
    assert found[1].information > found[0].information


def test_every_cause_keeps_the_limits(planned, surviving):
    known, limits = surviving
    judge = Judge(known, limits, seed=0)
    recording = planned.recording
    played = judge.played(recording.actions[0][None], recording.readings[0][:1])
    for k, channel in enumerate(limits.channels.values()):
        assert played.readings[..., k].max() <= channel.max
        assert played.readings[..., k].min() >= channel.min
    assert np.array_equal(played.readings[0, 0], recording.readings[0][1:])


def test_a_plan_is_the_same_with_the_same_seed(unrecorded):
    one, again, other = (plan_recording(*unrecorded, rounds=5, seed=s) for s in (1, 1, 2))
    assert again.recording == one.recording
    assert again.to_dict() == one.to_dict()
    assert other.recording != one.recording


def test_a_plan_for_several_causes_is_the_same_with_the_same_seed(surviving):
    one, again = (plan_within_limits(*surviving, rollouts=1, rounds=1, seed=1) for _ in range(2))
    assert again.recording == one.recording
    assert again.to_dict() == one.to_dict()


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
    assert record["version"] == VERSION
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
    values = prior_of(pendulum, known.time_step).to_parameters(cause.z[None])
    assert [float(values[n]) for n in ("mass", "length")] == pytest.approx([1.0, 0.9])
    # The priors are uniform on (0.3, 1.7): a density of 1/1.4 against a normal one of 0.4.
    width = cause.precision.inverse().diagonal().sqrt()
    assert width[0] == pytest.approx(0.1 / 1.4 / 0.3989, rel=0.05)
    limits = read_limits(None, default_limits(cause.simulator, None))
    found = plan_recording(known, limits, rounds=2)
    for narrowed, before in zip(found.widths, width.tolist(), strict=True):
        assert narrowed.after < narrowed.before == pytest.approx(before)


def test_a_plan_after_a_fit_has_its_time_step_and_noise(fitted):
    found = json.loads((fitted / "fit.json").read_text())
    found["preparation"] = {
        "segment_length": 25,
        "segment_seconds": 0.2,
        "noise": {"angle": 2e-3},
        "independent_share": 0.5,
    }
    (fitted / "fit.json").write_text(json.dumps(found))
    known = causes_of_run(fitted, pendulum)
    assert (known.share, known.segment_length) == (0.5, 25)
    simulator = known.causes[0].simulator
    limits = default_limits(simulator, None, time_step=known.time_step, noise=known.noise)
    assert limits.time_step == pytest.approx(0.008)
    assert {name: c.noise for name, c in limits.channels.items()} == {"angle": 2e-3}
    found["preparation"]["noise"] = {"angle": "small"}
    (fitted / "fit.json").write_text(json.dumps(found))
    with pytest.raises(DataError, match="a noise that is not a positive number"):
        causes_of_run(fitted, pendulum)


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
    assert "to name the right cause" in " ".join(text.split())
    assert all(cause in text for cause in CAUSES)
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
