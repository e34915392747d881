"""`npdr discover`: what it writes, where it stops, what it refuses, and that others accept it."""

import inspect
import json
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from npdr_ppl.cli import discover, show_discovery
from npdr_ppl.cli.resolve import resolve_model, resolve_rollouts
from npdr_ppl.discovery import DiscoveryOptions, Investigation, kept_fits
from npdr_ppl.run_files import save_tensors
from tests.helpers.command_line import assert_prints_sentence, run_for_module
from tests.helpers.discovery_recording import CANDIDATES, FRICTION, MISSING, pendulum_recording

NAMES = {
    "alarm", "where", "verdict", "effects", "ranking", "gap", "next_experiment", "data_problems",
    "separation", "parameters", "seconds", "stage",
}  # fmt: skip

FIGURES = {
    "residual_map", "latent_force", "ranking", "separation", "parameters", "effects", "gap"
}  # fmt: skip


def run(words):
    return run_for_module(*words)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "pendulum.csv"
    pendulum_recording().to_csv(path)
    return path


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    """A model that no package has."""
    file = tmp_path_factory.mktemp("model") / "mine.py"
    file.write_text(
        "import pyro, pyro.distributions as dist\n"
        "import npdr_ppl as npdr\n"
        "from npdr_ppl.models.pendulum import Pendulum\n\n"
        "def rod(inputs):\n"
        "    mass = pyro.sample('mass', dist.Uniform(0.3, 1.7))\n"
        "    length = pyro.sample('length', dist.Uniform(0.3, 1.7))\n"
        "    values = {'mass': mass, 'length': length}\n"
        "    return npdr.simulate('trajectory', Pendulum(), values, inputs)\n"
    )
    return file


@pytest.fixture(scope="module")
def words(recording, model_file, tmp_path_factory):
    return [
        "discover", f"{model_file}:rod", "--data", recording, "--holdout", 3, "--candidates",
        CANDIDATES, "--max-effects", 1,
        "--out", tmp_path_factory.mktemp("out") / "discovery",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def finished(words):
    """A finished discovery: its folder and what was printed."""
    code, text, err = run(words)
    assert code == 0, err
    return Path(words[-1]), text


@pytest.mark.slow
def test_it_names_what_is_missing(finished):
    folder, text = finished
    found = json.loads((folder / "discovery.json").read_text())
    assert NAMES <= set(found)
    assert found["verdict"] == "named"
    assert_prints_sentence(text, found["preparation"])
    (effect,) = found["effects"]
    assert f"{effect['port']}.{effect['effect']}" == MISSING
    assert {"probability", "equivalent_to", "parameters"} <= set(effect)
    assert effect["in_halves"] == {"the first half": True, "the second half": True}
    magnitude = effect["parameters"]["magnitude"]
    assert set(magnitude) == {"mean", "sd", "hdi_94", "unit"}
    assert abs(magnitude["mean"] - FRICTION) < 0.2 * FRICTION
    assert found["alarm"]["fired"] is True and found["alarm"]["p_value"] < 0.01
    assert set(found["where"][0]) == {"rollout", "time_span", "channel", "region", "z"}
    for metric in ("rmse", "dtw", "crps"):
        gap = found["gap"][metric]
        assert set(gap) == {"before", "after", "noise_floor", "closed"}
        assert gap["after"] < gap["before"]
    assert "coulomb_friction" in text and "named" in text and "rmse" in text
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.slow
def test_its_draws_are_those_of_the_posterior(finished, tmp_path):
    folder, _ = finished
    found = json.loads((folder / "discovery.json").read_text())["parameters"]
    code, _, err = run(["export", folder, "--to", tmp_path / "ranges.json", "--draws", 1000])
    assert code == 0, err
    ranges = json.loads((tmp_path / "ranges.json").read_text())
    draws = np.array(ranges["draws"])
    assert draws.shape == (1000, len(found))
    for column, name in zip(draws.T, ranges["names"], strict=True):
        # Systematic resampling is more even than independent draws; these are five standard
        # errors of independent ones.
        assert abs(column.mean() - found[name]["mean"]) < 5.0 * found[name]["sd"] / 1000**0.5
        assert column.std() == pytest.approx(found[name]["sd"], rel=0.15)
    assert ranges["parameters"][MISSING + ".magnitude"]["unit"] == "N m"


@pytest.mark.slow
def test_it_draws_its_figures(finished):
    folder, _ = finished
    assert {file.stem for file in folder.glob("*.png")} == FIGURES
    assert all(file.stat().st_size > 1_000 for file in folder.glob("*.png"))


@pytest.mark.slow
def test_other_commands_accept_the_revised_model(finished, recording, tmp_path):
    folder, _ = finished
    model = f"{folder}/revised_model.py:revised_model"
    assert repr(resolve_model(model)) == f"rod + {MISSING}"
    code, _, err = run(
        [
            "fit", model, "--data", recording, "--out", tmp_path / "fit", "--rounds", 1,
            "--simulations", 60, "--segment-length", 50, "--embedding", "all/5", "--quiet",
        ]
    )  # fmt: skip
    assert code == 0, err
    fit = json.loads((tmp_path / "fit/fit.json").read_text())
    assert set(fit["parameters"]) == {"mass", "length", f"{MISSING}.magnitude"}


@pytest.mark.slow
def test_a_finished_discovery_is_not_repeated(finished, words, monkeypatch):
    def never(*_):
        raise AssertionError("it was searched again")

    monkeypatch.setattr(Investigation, "conclude", never)
    code, text, _ = run(words)
    assert (code, text) == (0, finished[1])
    code, text, _ = run([*words, "--quiet"])
    assert (code, text) == (0, "")
    code, _, err = run([*words, "--seed", 1])
    assert code == 2 and "differs in seed" in err


@pytest.mark.slow
def test_a_killed_discovery_continues_to_the_same_result(finished, words, tmp_path, monkeypatch):
    out = tmp_path / "killed"
    words = [*map(str, words[:-1]), str(out), "--quiet"]
    process = subprocess.Popen([sys.executable, "-m", "npdr_ppl.cli", *words])
    deadline = time.monotonic() + 600
    while len(list(out.glob("fits/*.safetensors"))) < 4:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = {file.name for file in out.glob("fits/*.safetensors")}
    damaged = min(kept)
    (out / "fits" / damaged).write_bytes(b"half")
    made = []

    def save(file, tensors):
        made.append(file.name)
        save_tensors(file, tensors)

    monkeypatch.setattr(kept_fits, "save_tensors", save)
    code, _, err = run(words)
    assert code == 0, err
    assert kept & set(made) == {damaged} and len(made) > 1
    results = [json.loads((f / "discovery.json").read_text()) for f in (out, finished[0])]
    for result in results:
        del result["seconds"]
    assert results[0] == results[1]
    assert not (out / "fits").exists()  # a finished discovery needs them no more


@pytest.mark.slow
def test_stages_stop_where_they_are_told_and_an_unfinished_run_goes_on(words, tmp_path):
    words = [*words[:-1], tmp_path / "stages", "--stage"]
    folder = tmp_path / "stages"
    expected = {
        "check": ({"data_problems", "remarks"}, set()),
        "locate": ({"data_problems", "remarks", "where"}, {"residual_map"}),
        "alarm": (
            {"data_problems", "remarks", "where", "alarm", "ranking"},
            {"residual_map", "latent_force", "ranking", "separation"},
        ),
    }
    for stage, (names, figures) in expected.items():
        code, text, err = run([*words, stage])
        assert code == 0, err
        found = json.loads((folder / "discovery.json").read_text())
        assert set(found) == names | {"stage", "seconds"}
        assert {file.stem for file in folder.glob("*.png")} == figures
        assert not (folder / "revised_model.py").exists()
    assert "alarm" in text
    # As if killed before the end: nothing says that it is finished, so it goes on.
    (folder / "discovery.json").unlink()
    assert run([*words, "check"])[0] == 0
    assert json.loads((folder / "discovery.json").read_text())["stage"] == "check"


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (["--candidates", "hinge.coulomb"], "did you mean 'coulomb_friction'"),
        (["--candidates", "knee.bias"], "knee"),
        (["--candidates", "knee.bias", "--candidates", "hinge.bias"], "knee"),
        (["--candidates", "hinge.input_delay"], "hinge"),
        (["--effect", "hinge.coulomb"], "did you mean 'coulomb_friction'"),
        (["--holdout", "9"], "has 4"),
        (["--holdout-data", "DATA"], "give one"),
        (["--false-alarm-rate", "2"], "between 0 and 1"),
        (["--segment-length", "400"], "too few"),
        (["--segment-length", "0"], "got whole rollouts"),
        (["--segment-length", "short"], "a number of steps, auto or 0"),
        (["--initial-state", "recorded"], "initial_state must be 'uncertain'"),
        (["--noise", "model"], "noise must be 'auto'"),
    ],
)
def test_bad_input_gets_one_sentence(words, recording, tmp_path, changed, sentence):
    changed = [recording if word == "DATA" else word for word in changed]
    code, _, err = run([*words[:-1], tmp_path / "out", *changed, "--stage", "check"])
    assert code == 2
    assert sentence in err and "Traceback" not in err
    assert len(err.strip().splitlines()) == 1


def test_held_out_rollouts_come_from_the_same_file_or_another(recording, tmp_path):
    other = tmp_path / "other.csv"
    pendulum_recording(num_rollouts=2, num_steps=50).to_csv(other)
    for words in (["1,3"], ["1", "3"]):
        fitted, held_out = resolve_rollouts([recording], words)
        assert (len(fitted), len(held_out)) == (2, 2)
    fitted, held_out = resolve_rollouts([recording], holdout_data=other)
    assert (len(fitted), len(held_out)) == (4, 2)
    assert resolve_rollouts([recording])[1] is None


def test_an_ambiguous_verdict_is_printed_with_what_to_record_next(monkeypatch, tmp_path):
    text = StringIO()
    monkeypatch.setattr(
        show_discovery, "console_for_tables", lambda: Console(file=text, width=100)
    )
    found = {
        "data_problems": [], "verdict": "ambiguous", "reason": "It cannot tell.", "effects": [],
        "gap": {}, "remainder": {"fired": True, "unexplained": 0.05},
        "counts": {"angle": {"size": 0.00307, "share": 0.42}, "way": {"size": 1.0, "share": 0.01}},
        "next_experiment": {
            "excitation": "slow_ramp", "separations": {"slow_ramp": 12.3, "hold": None},
            "amplitude": {"torque": 4.0}, "separated_by": "a change of load",
        },
    }  # fmt: skip
    show_discovery.show_discovery(found, tmp_path)
    shown = " ".join(text.getvalue().split())
    assert "ambiguous: It cannot tell." in shown
    assert "slow ramp with torque up to 4, which separates the alternatives by 12" in shown
    assert "a change of load" in shown and "5.00%" in shown
    assert "angle has an encoder resolution of 0.00307, which causes 42%" in shown
    assert "way" not in shown


def test_a_learned_law_is_printed_with_its_checks(monkeypatch, tmp_path):
    text = StringIO()
    monkeypatch.setattr(
        show_discovery, "console_for_tables", lambda: Console(file=text, width=100)
    )
    law = {"port": "hinge", "with_numbers": "− 0.02 v³", "unit": "N m"}
    found = {
        "data_problems": [], "verdict": "learned", "reason": "Learned.", "effects": [], "gap": {},
        "remainder": {"fired": False, "unexplained": 0.0}, "counts": {}, "next_experiment": None,
        "learned": {
            "offered": True, "laws": [law], "depends_on": {"hinge": {"v": 1.0}},
            "alike": {"hinge": {"effect": "hinge.quadratic_drag", "correlation": 0.93}},
            "checks": [{"where": "the first half", "before": 12.5, "after": 1.25}],
        },
    }  # fmt: skip
    show_discovery.show_discovery(found, tmp_path)
    shown = " ".join(text.getvalue().split())
    assert "hinge − 0.02 v³ N m" in shown and "the first half 12.5 1.25" in shown
    assert "Explained misfit lost at hinge without v 100%." in shown
    assert "hinge.quadratic_drag, correlation 0.93" in shown


def test_effects_that_are_too_small_are_printed_apart(monkeypatch, tmp_path):
    text = StringIO()
    monkeypatch.setattr(
        show_discovery, "console_for_tables", lambda: Console(file=text, width=100)
    )
    strength = {"mean": 0.1, "sd": 0.01, "hdi_94": [0.08, 0.12], "unit": "N m"}
    found = {
        "data_problems": [], "verdict": "named", "reason": "Missing: hinge.bias.", "gap": {},
        "effects": [
            {"effect": effect, "port": "hinge", "probability": 0.99, "is_minor": is_minor,
             "parameters": {"size": strength},
             "doubt": "is contradicted by the first half" if is_minor else ""}
            for effect, is_minor in (("bias", False), ("wind", True))
        ],
        "remainder": {"fired": False, "unexplained": 0.0}, "counts": {}, "next_experiment": None,
    }  # fmt: skip
    show_discovery.show_discovery(found, tmp_path)
    shown = " ".join(text.getvalue().split())
    assert "Too small to be named, but in the model: hinge.wind." in shown
    assert "hinge.wind is contradicted by the first half." in shown
    assert "hinge.bias is contradicted" not in shown
    assert "Not compared with alternatives" not in shown
    found["effects"][0]["probability"] = None  # a time limit ended the search
    # JSON has no infinite mean.
    found["effects"][0]["parameters"] = {"size": {**strength, "mean": None, "sd": None}}
    show_discovery.show_discovery(found, tmp_path)
    assert "Not compared with alternatives: hinge.bias." in " ".join(text.getvalue().split())


def test_the_command_has_the_defaults_of_the_options():
    declared = inspect.signature(discover.discover).parameters
    for name in ("max_effects", "false_alarm_rate"):
        assert declared[name].default == getattr(DiscoveryOptions(), name)
