"""The command line: JSON that others rely on, figures, and one sentence for bad input."""

import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from npdr_ppl.posterior.fit import FITS
from npdr_ppl.preparation.segment_fit import fit_segments
from npdr_ppl.rollouts import Rollouts
from tests.helpers.command_line import assert_prints_sentence, run

RECORDING = Path(__file__).parents[3] / "shared/data/quanser_qube/swing_up_500hz_5s.csv"


@pytest.fixture
def recording(tmp_path):
    """A pendulum recording made by scipy, with a little noise."""
    from scipy.integrate import solve_ivp

    time = 0.02 * np.arange(101)
    torque = 2.0 * np.sin(2 * math.pi * time)
    rng = np.random.default_rng(0)

    def swing(t, y):
        # The torque is held over each step, as a controller does.
        held = torque[min(int(t / 0.02 + 1e-9), 100)]
        return [y[1], (held - 0.9 * 9.81 * 0.55 * math.sin(y[0])) / (0.9 * 1.1**2 / 3)]

    readings, actions = [], []
    for start in (0.0, 0.4):
        exact = solve_ivp(swing, (0, 2.0), [start, 0.0], t_eval=time, max_step=0.02).y.T
        readings.append(exact + rng.normal(0, [0.005, 0.02], exact.shape))
        actions.append(torque[:-1, None])
    path = tmp_path / "pendulum.csv"
    Rollouts.from_arrays(
        readings=readings, actions=actions, channel_names=("angle", "velocity"),
        action_names=("torque",), time_step=0.02,
    ).to_csv(path)  # fmt: skip
    return path


@pytest.mark.slow
def test_fit_writes_what_the_documentation_promises(monkeypatch, capsys, tmp_path, recording):
    out = tmp_path / "fit"
    words = [
        "fit", "pendulum", "--data", recording, "--holdout", 1, "--out", out, "--rounds", 1,
        "--simulations", 200, "--segment-length", 25, "--embedding", "all/5", "--backend",
        "snpe-c(members=2)",
    ]  # fmt: skip
    code, text, _ = run(monkeypatch, capsys, *words)
    assert code == 0
    assert "most likely" in text
    fit = json.loads((out / "fit.json").read_text())
    assert fit["preparation"]["segment_length"] == 25
    assert_prints_sentence(text, fit["preparation"])
    assert fit["backend"] == "snpe-c"
    assert set(fit["parameters"]["mass"]) == {"mean", "sd", "hdi_94"}
    assert 0.3 <= fit["most_likely"]["length"] <= 1.7
    assert {"rmse", "dtw"} <= set(fit["metrics"])
    assert set(fit["seconds"]) == {"simulate", "train", "sample"}
    assert fit["diagnosis"]["decision"] in {
        "accept", "more rounds", "widen", "new rollout", "revise the model", "stop"
    }  # fmt: skip
    for name in ("posterior.nc", "marginals.png", "pairs.png", "bands.png"):
        assert (out / name).stat().st_size > 1_000
    # The same command again continues, finds everything done, and says the same.
    code, _, _ = run(monkeypatch, capsys, *words)
    again = json.loads((out / "fit.json").read_text())
    assert code == 0
    assert again["parameters"] == fit["parameters"]


def test_report_writes_one_file(monkeypatch, capsys, tmp_path):
    (tmp_path / "discovery.json").write_text('{"verdict": "none"}')
    page = tmp_path / "page.html"
    code, text, _ = run(monkeypatch, capsys, "report", tmp_path, "--file", page)
    assert code == 0
    assert str(page) in text
    assert "No effect is missing" in page.read_text()
    code, _, err = run(monkeypatch, capsys, "report", tmp_path / "absent")
    assert code == 2
    assert err.count("\n") == 1


def test_report_compares_several_runs(monkeypatch, capsys, tmp_path):
    for name in ("monday", "tuesday"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "discovery.json").write_text('{"verdict": "none"}')
    page = tmp_path / "page.html"
    folders = tmp_path / "monday", tmp_path / "tuesday"
    code, text, _ = run(monkeypatch, capsys, "report", *folders, "--file", page)
    assert code == 0
    assert str(page) in text
    assert "The runs agree" in page.read_text()
    code, _, err = run(monkeypatch, capsys, "report", *folders, tmp_path / "monday")
    assert code == 2
    assert err.count("\n") == 1 and "given twice" in err


@pytest.mark.slow
def test_fit_takes_a_models_file_and_effects(monkeypatch, capsys, tmp_path, recording):
    file = tmp_path / "json.py"  # must not take the standard library's place
    file.write_text(
        "import pyro, pyro.distributions as dist\n"
        "import npdr_ppl as npdr\n"
        "from npdr_ppl.models.pendulum import Pendulum\n\n"
        "def heavy(inputs):\n"
        "    mass = pyro.sample('mass', dist.Uniform(0.3, 1.7))\n"
        "    return npdr.simulate('trajectory', Pendulum(), {'mass': mass}, inputs, noise=0.1)\n"
    )
    out = tmp_path / "fit"
    code, _, _ = run(
        monkeypatch, capsys, "fit", f"{file}:heavy", "--data", recording, "--out", out,
        "--effect", "hinge.coulomb_friction", "--rounds", 1, "--simulations", 100, "--quiet",
    )  # fmt: skip
    assert code == 0
    fit = json.loads((out / "fit.json").read_text())
    assert set(fit["parameters"]) == {"mass", "hinge.coulomb_friction.magnitude"}
    assert fit["noise"] is None, "the model's own noise is kept"
    assert sys.modules["json"] is json
    # Results of a model are not shown as those of a corrected one.
    file.write_text(file.read_text().replace("'mass': mass", "'mass': 2.0 * mass"))
    module = sys.modules["npdr_ppl.posterior.fit"]
    monkeypatch.setattr(module, "prepare", lambda *_, **__: pytest.fail("not refused at once"))
    code, _, err = run(
        monkeypatch, capsys, "fit", f"{file}:heavy", "--data", recording, "--out", out,
        "--effect", "hinge.coulomb_friction", "--rounds", 1, "--simulations", 100, "--quiet",
    )  # fmt: skip
    assert code == 2 and "differs in the model's code" in err


@pytest.mark.slow
def test_compare_writes_what_the_documentation_promises(monkeypatch, capsys, tmp_path, recording):
    out = tmp_path / "comparison"
    words = [
        "compare", "pendulum", "--data", recording, "--holdout", 1, "--out", out, "--rounds", 1,
        "--simulations", 60, "--segment-length", 25, "--embedding", "all/5", "--backends",
        "snpe-c(epochs=2), maf = snpe-c(flow=maf, members=1, epochs=2)",
    ]  # fmt: skip
    code, text, _ = run(monkeypatch, capsys, *words)
    assert code == 0
    assert "60 simulations each" in text
    assert max(map(len, text.splitlines())) <= 100
    comparison = json.loads((out / "comparison.json").read_text())
    assert_prints_sentence(text, comparison["preparation"])
    assert set(comparison["backends"]) == set(comparison["ranking"]) == set(comparison["weights"])
    assert set(comparison["ranking"]) == {"snpe-c(epochs=2)", "maf"}
    for row in comparison["backends"].values():
        assert {"rmse", "dtw", "crps", "elpd", "r_hat", "seconds", "decision"} <= set(row)
        assert row["num_simulations"] == 60
    for name in ("marginals.png", "pairs.png", "bands.png", "seconds.png"):
        assert (out / name).stat().st_size > 1_000
    # The same command again continues, finds everything done, and says the same.
    code, text, _ = run(monkeypatch, capsys, *words, "--quiet")
    again = json.loads((out / "comparison.json").read_text())
    assert (code, text) == (0, "")
    assert again["weights"] == comparison["weights"]
    code, _, err = run(monkeypatch, capsys, *words, "--seed", 1)
    assert code == 2 and "differs in seed" in err


@pytest.mark.slow
@pytest.mark.parametrize("embedding", ["all/5", "score"])
def test_a_killed_fit_continues_to_the_same_result(
    monkeypatch, capsys, tmp_path, recording, embedding
):
    words = [
        "fit", "pendulum", "--data", recording, "--rounds", 2, "--simulations", 100,
        "--segment-length", 25, "--embedding", embedding, "--quiet", "--backend",
        "snpe-c(members=2, epochs=20)", "--out",
    ]  # fmt: skip
    killed = tmp_path / "killed"
    command = [sys.executable, "-m", "npdr_ppl.cli", *map(str, words), str(killed)]
    process = subprocess.Popen(command)
    deadline = time.monotonic() + 120
    while not (killed / "run" / "round_0.json").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (killed / "fit.json").exists()
    results = []
    for out in (killed, tmp_path / "undisturbed"):
        assert run(monkeypatch, capsys, *words, out)[0] == 0
        results.append(json.loads((out / "fit.json").read_text()))
    if embedding == "score":  # derived from a fit, with other rounding errors if that was read
        for key in ("mean", "sd"):
            one, other = ({n: row[key] for n, row in r["parameters"].items()} for r in results)
            assert one == pytest.approx(other, rel=1e-3)
    else:
        assert results[0]["parameters"] == results[1]["parameters"]
        assert results[0]["metrics"] == results[1]["metrics"]
    assert not (killed / FITS).exists()


def test_an_interrupted_fit_has_kept_its_closest_parameters(
    monkeypatch, capsys, tmp_path, recording
):
    made = []
    words = ["fit", "pendulum", "--data", recording, "--quiet", "--out", tmp_path / "fit"]

    def counted(*args, **options):
        made.append(1)
        return fit_segments(*args, **options)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("npdr_ppl.discovery.hypothesis.fit_segments", counted)
    monkeypatch.setattr("npdr_ppl.posterior.fit.infer", interrupted)
    numbers = []
    for _ in range(2):
        code, _, err = run(monkeypatch, capsys, *words)
        assert code == 130 and "continues the run" in err
        numbers.append(len(made))
    assert numbers[0] == numbers[1] > 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fit", "pendulun", "--data", "DATA", "--out", "OUT"], "did you mean 'pendulum'"),
        (["fit", "nothing.py:f", "--data", "DATA", "--out", "OUT"], "nothing.py does not exist"),
        (["fit", "furuta", "--data", "DATA", "--out", "OUT"], "arm_angle"),
        (["fit", "pendulum", "--data", "missing.csv", "--out", "OUT"], "missing.csv"),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--holdout", "7"], "has 2"),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--holdout", "x"], "3,4"),
        (
            ["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--holdout", "0",
             "--holdout-data", "DATA"],
            "exclude each other",
        ),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--backend", "mcmc"], "mcmc"),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--backend", "snpe-c(flw=maf)"],
         "did you mean 'flow'"),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--backend",
          "snpe-c(embedding=some/5)"], "some/5"),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--effect", "hinge.coulomb"],
         "did you mean 'coulomb_friction'"),
        (["fit", "pendulum", "--data", "DATA", "--out", "OUT", "--effect", "knee.bias"],
         "no port 'knee'"),
        (["compare", "pendulum", "--data", "DATA", "--out", "OUT", "--backends", "snpec"],
         "did you mean 'snpe-c'"),
        (["compare", "pendulum", "--data", "DATA", "--out", "OUT", "--backends", "snpe-c(flow"],
         "parenthesis open"),
        (["compare", "pendulum", "--data", "DATA", "--out", "OUT", "--backends", "snpe-c,snpe-c"],
         "cannot be told apart"),
        (["reproduce", "table2"], "pass --data"),
        (["reproduce", "mini-golf"], "pass --data"),
        (["reproduce", "missing-effect"], "pass --data"),
        (["reproduce", "missing-effect", "--data", "OUT"], "does not exist"),
        (["reproduce", "pendulum", "--backends", "mcmc"], "mcmc"),
        (["reproduce", "pendulum", "--rounds", "2"], "belongs to mini-golf"),
        (["reproduce", "missing-effect", "--backends", "abc"],
         "belongs to table2, pendulum, mini-golf"),
    ],
)  # fmt: skip
def test_bad_input_gets_one_sentence(monkeypatch, capsys, tmp_path, recording, words, sentence):
    replaced = {"DATA": recording, "OUT": tmp_path / "out"}
    code, _, err = run(monkeypatch, capsys, *[replaced.get(word, word) for word in words])
    assert code == 2
    assert sentence in err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "command", ["models", "backends", "effects", "targets", "tasks", "searches"]
)
def test_listings(monkeypatch, capsys, command):
    code, text, _ = run(monkeypatch, capsys, command, "--json")
    rows = json.loads(text)
    assert code == 0
    assert all(row["summary"] for row in rows)
    for columns in (60, 80):
        monkeypatch.setenv("COLUMNS", str(columns))
        code, text, _ = run(monkeypatch, capsys, command)
        assert code == 0
        # Each name stands on a line of its own, as it is to be typed.
        assert {row["name"] for row in rows} <= set(text.splitlines())
        assert max(map(len, text.splitlines())) <= columns
    # No name in the details is cut, however narrow the terminal is.
    monkeypatch.setenv("COLUMNS", "40")
    for row in rows:
        code, text, _ = run(monkeypatch, capsys, command, row["name"])
        words = [word for value in row.values() for word in _texts(value)]
        assert code == 0 and set(words) <= set(text.split()) | {""}


def _texts(value):
    """Returns the words of a row's value, unbroken."""
    return [w for v in (value if isinstance(value, list) else [value]) for w in str(v).split()]


def test_a_listing_shows_the_details_of_one_name(monkeypatch, capsys):
    code, text, _ = run(monkeypatch, capsys, "models", "cart_pole")
    assert code == 0
    assert "    cart_damping [N s/m]" in text.splitlines()
    code, _, err = run(monkeypatch, capsys, "models", "cartpole")
    assert code == 2 and "did you mean 'cart_pole'?" in err


@pytest.mark.slow
@pytest.mark.skipif(not RECORDING.exists(), reason=f"the recordings {RECORDING} are absent")
def test_table2_has_both_columns_beside_the_papers(monkeypatch, capsys, tmp_path):
    from npdr_ppl.reproduction import table2

    # One round of few simulations, not the figure of docs/reproduction/table2_furuta.md.
    monkeypatch.setattr(table2, "ROUNDS", 1)
    monkeypatch.setattr(table2, "NUM_SIMULATIONS", 100)
    code, text, _ = run(
        monkeypatch, capsys, "reproduce", "table2", "--data", RECORDING, "--out", tmp_path
    )
    assert code == 0
    result = json.loads((tmp_path / "table2/table2.json").read_text())
    # A column is computed, or the output says why not.
    for method in table2.COLUMNS:
        reason = result["skipped"].get(method) or result["failed"].get(method)
        assert (method in result["rows"]) != (reason is not None)
        assert reason is None or f"{method} " in text
    # The paper's own figures, which its recipe reproduces.
    assert abs(result["rows"]["nominal"]["rmse"]["mean"] - 0.384) < 0.002
    assert abs(result["rows"]["nominal"]["dtw"]["mean"] - 1431) < 15
    assert result["rows"]["snpe-c"]["rmse"]["mean"] < result["rows"]["nominal"]["rmse"]["mean"]
    assert result["paper"]["snpe-c"]["rmse"]["mean"] == 0.263
