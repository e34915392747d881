"""`npdr train`: what it writes, how it continues, and one sentence for bad input."""

import json

import numpy as np
import pytest

from npdr_ppl.cli.resolve import (
    resolve_backend,
    resolve_effects,
    resolve_search,
    resolve_target,
    resolve_task,
)
from npdr_ppl.errors import ModelError, NpdrError
from npdr_ppl.models.furuta import furuta
from npdr_ppl.rollouts import Rollouts
from tests.helpers.command_line import assert_prints_sentence, run
from tests.helpers.small_loop import without_remedies

RIG = """
import dataclasses
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.loop.control_task import control_task

class Stuck:
    pass

def short():
    return dataclasses.replace(control_task("furuta-swing-up"), num_steps=60)

def interrupted():
    target = furuta_target("furuta-easy")
    def run(*args, **kwargs):
        raise KeyboardInterrupt
    target.run = run
    return target

def wrong():
    return Stuck()

def broken():
    raise ValueError("no rig at port 7")
"""

QUICK = [
    "--rounds", 1, "--simulations", 20, "--segment-length", 20, "--embedding", "all/10",
    "--backend", "snpe-c(transforms=1, hidden=(8,), epochs=2, members=2)",
    "--search", "power(population=3)", "--search-iterations", 1, "--domains", 3,
]  # fmt: skip


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.py"
    path.write_text(RIG)
    return path


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "recorded.csv"
    Rollouts.from_arrays(
        readings=np.zeros((2, 5, 2)), actions=np.zeros((2, 4, 1)),
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=0.02,
    ).to_csv(path)  # fmt: skip
    return path


@pytest.mark.slow
@pytest.mark.usefixtures("few_draws")
def test_a_run_and_its_continuation(monkeypatch, capsys, tmp_path, rig):
    out = tmp_path / "run"
    words = [
        "train", "furuta", "--target", "furuta-random-7", "--task", f"{rig}:short", "--out", out,
        "--rollouts", 2, "--no-decisions", *QUICK,
    ]  # fmt: skip
    with without_remedies():
        code, text, err = run(monkeypatch, capsys, *words, "--iterations", 1, "--animate")
    assert code == 0, err
    assert "Simulated return" in text and "decisions are only logged" in text
    assert "deploy: The policy succeeds in" in text
    assert max(map(len, text.splitlines())) <= 100
    first = json.loads((out / "train.json").read_text())
    assert_prints_sentence(text, first["iterations"][-1]["preparation"])
    assert {"decision", "reason", "real_return", "sim_return"} <= set(first["iterations"][0])
    assert len(first["iterations"][0]["real_returns"]) == 2
    for name in ("learning_curve.png", "rollouts.png", "parameters.png", "rollout.gif"):
        assert (out / name).stat().st_size > 1_000
    # A run is not continued with other settings.
    for changed, sentence in {
        ("--seed", 1): "differs in seed;",
        ("--spread", 0.2): "differs in spread;",
        ("--embedding", "all/20"): "differs in how the data are prepared;",
    }.items():
        code, _, err = run(monkeypatch, capsys, *words, *changed)
        assert code == 2 and sentence in err and len(err.strip().splitlines()) == 1
    # More iterations continue it; figures are made anew.
    (out / "learning_curve.png").unlink()
    with without_remedies():
        code, text, _ = run(monkeypatch, capsys, *words, "--iterations", 2, "--json", "--quiet")
    assert code == 0
    second = json.loads(text)
    assert second == json.loads((out / "train.json").read_text())
    assert second["iterations"][0] == first["iterations"][0]
    assert len(second["iterations"]) == 2
    assert (out / "learning_curve.png").exists()


@pytest.mark.slow
def test_what_the_model_lacks_is_looked_for_where_that_is_asked_for(
    monkeypatch, capsys, tmp_path, rig
):
    out = tmp_path / "run"
    code, _, err = run(
        monkeypatch, capsys, "train", "furuta", "--target", "furuta-random-7", "--task",
        f"{rig}:short", "--out", out, "--iterations", 1, "--discover", "--least-success", 0.5,
        "--tail-share", 0.3, *QUICK,
    )  # fmt: skip
    assert code == 0, err
    described = json.loads((out / "loop.json").read_text())["options"]
    assert described["discovers"] == "before inference"
    assert (described["least_success"], described["tail_share"]) == (0.5, 0.3)
    # Sixty steps are too few for any effect to show.
    assert json.loads((out / "train.json").read_text())["iterations"][0]["effects"] == []


def test_ctrl_c_says_how_to_go_on(monkeypatch, capsys, tmp_path, rig):
    out = tmp_path / "run"
    code, _, err = run(
        monkeypatch, capsys, "train", "furuta", "--target", f"{rig}:interrupted", "--task",
        f"{rig}:short", "--out", out, *QUICK,
    )  # fmt: skip
    assert code not in (0, 2)
    assert f"the same command again continues the run in {out}" in err
    assert "Traceback" not in err
    assert (out / "loop.json").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--target", "furta-hard"], "did you mean 'furuta-hard'"),
        (["--target", "furuta-hrad"], "did you mean 'furuta-hard'"),
        (["--target", "missing.csv"], "missing.csv"),
        (["--target", "missing.py:rig"], "missing.py does not exist"),
        (["--target", "RIG:nothing"], "no function 'nothing'"),
        (["--target", "RIG:wrong"], "should return a TargetDomain; it returned a Stuck"),
        (["--target", "RIG:broken"], "no rig at port 7"),
        (["--target", "furuta-easy", "--task", "furuta-swing-down"], "furuta-swing-up"),
        (["--target", "furuta-easy", "--task", "RIG:wrong"], "should return a ControlTask"),
        (["--target", "furuta-easy", "--backend", "mcmc"], "mcmc"),
        (["--target", "furuta-easy", "--backend", "snpe-c(flw=maf)"], "did you mean 'flow'"),
        (["--target", "furuta-easy", "--search", "powre"], "did you mean 'power'"),
        (["--target", "furuta-easy", "--search", "power(population=many)"], "wrong type"),
        (["--target", "furuta-easy", "--effect", "arm.coulomb"], "'coulomb_friction'"),
        (["--target", "furuta-easy", "--segment-length", "long"], "a number of steps, auto or 0"),
        (["--target", "DATA", "--rollouts", "3"], "has 2 rollouts, too few"),
        (["--target", "DATA", "--animate"], "no channel arm_angle, pole_angle"),
    ],
)
def test_bad_input_gets_one_sentence(
    monkeypatch, capsys, tmp_path, rig, recording, words, sentence
):
    words = [word.replace("RIG", str(rig)).replace("DATA", str(recording)) for word in words]
    out = tmp_path / "run"
    code, _, err = run(monkeypatch, capsys, "train", "furuta", "--out", out, *words)
    assert code == 2
    assert sentence in err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    assert not out.exists(), "what never began leaves nothing to continue"


def test_targets_come_from_everywhere(monkeypatch, recording):
    assert resolve_target("furuta-random-7").name == "furuta-random-7"
    recorded = resolve_target(str(recording))
    assert recorded.is_recorded and recorded.num_episodes == 2
    assert recorded.name == "recorded"
    # A file may well be called like a target.
    named = recording.rename(recording.with_name("furuta-easy.csv"))
    assert resolve_target(str(named)).is_recorded
    with pytest.raises(NpdrError, match="NoSuchRobot"):
        resolve_target("gym:NoSuchRobot-v1")


def test_gymnasium_targets():
    pytest.importorskip("gymnasium")
    assert resolve_target("gym:Pendulum-v1").name == "Pendulum-v1"


def test_tasks_go_with_models_of_the_zoo(rig):
    assert resolve_task("", "furuta").name == "furuta-swing-up"
    assert resolve_task(f"{rig}:short", "pendulum").num_steps == 60
    with pytest.raises(ModelError, match="no task that goes with pendulum.*--task"):
        resolve_task("", "pendulum")


def test_methods_without_options_stay_words():
    assert resolve_search("power") == "power"
    assert resolve_search("power(population=7)").population == 7
    assert resolve_backend("snpe-a", "score") == ("snpe-a", "score")
    method, embedding = resolve_backend("snpe-c(members=2, embedding=all/5)", "score")
    assert (method.members, embedding) == (2, "all/5")


def test_effects_are_split_at_the_commas_between_them():
    several = "arm.coulomb_friction, arm_velocity,pole_velocity.sensor_low_pass"
    attached = resolve_effects(furuta, [several, "pole.coulomb_friction"]).effects
    assert [effect.name for effect, _ in attached] == [
        "arm.coulomb_friction",
        "arm_velocity,pole_velocity.sensor_low_pass",
        "pole.coulomb_friction",
    ]
