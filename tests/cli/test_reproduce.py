"""`npdr reproduce` on small recordings and budgets: what is written, and where it comes from."""

import json
import sys
from dataclasses import replace

import pytest

from npdr_ppl.loop.control_task import control_task
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.policies.furuta_swing_up import FurutaSwingUp
from npdr_ppl.reproduction import rig_study, table2
from tests.helpers.command_line import run
from tests.helpers.small_rig_study import NUM_STEPS, tiny_options


@pytest.fixture
def swing_ups(tmp_path):
    """Five swing-ups of a rig in MuJoCo, of 0.8 s."""
    target, policy = furuta_target("furuta-easy"), FurutaSwingUp()
    controllers = [policy.controller(Furuta().nominal()) for _ in range(5)]
    first, *others = [target.run(c, 400, seed=seed) for seed, c in enumerate(controllers)]
    path = tmp_path / "swing_ups.csv"
    first.concatenate(*others).to_csv(path)
    return path


def test_a_score_that_cannot_be_computed_is_said_before_anything_is_fitted(
    monkeypatch, capsys, tmp_path
):
    monkeypatch.setitem(sys.modules, "sklearn", None)  # as after a plain installation
    out = tmp_path / "run"
    code, _, err = run(monkeypatch, capsys, "reproduce", "pendulum", "--out", out)
    assert code == 2 and "pip install scikit-learn" in err
    assert len(err.splitlines()) == 1
    assert not out.exists()


@pytest.mark.slow
def test_rows_of_returns_are_those_of_runs_on_the_rig(monkeypatch, capsys, tmp_path, swing_ups):
    # Few methods, short episodes and tiny searches: the machinery, not the figures.
    methods = {"nominal": "nominal", "default gains": "default gains"}
    task = replace(control_task("furuta-swing-up"), num_steps=NUM_STEPS)
    monkeypatch.setattr(table2, "RETURN_METHODS", methods)
    monkeypatch.setattr(table2, "LoopOptions", tiny_options)
    monkeypatch.setattr(rig_study, "control_task", lambda name: task)
    words = [
        "reproduce", "table2", "--data", swing_ups, "--out", tmp_path / "run", "--returns", 2,
        "--backends", "bayesian-linear-regression", "--quiet",
    ]  # fmt: skip
    code, _, err = run(monkeypatch, capsys, *words)
    assert code == 0, err
    out = tmp_path / "run/table2"
    result = json.loads((out / "table2.json").read_text())
    assert (result["rig"], result["training_seeds"]) == ("furuta-hard", 2)
    # Methods that are scored on recordings have all figures, those of no recording returns alone.
    assert set(result["rows"]["nominal"]) == {"rmse", "dtw", "return_sim", "return_rig"}
    assert set(result["rows"]["default gains"]) == {"return_sim", "return_rig"}
    assert set(result["rows"]["bayesian-linear-regression"]) == {"rmse", "dtw"}
    runs = {path.parent.name for path in (out / "returns").glob("*/outcome.json")}
    assert runs == {f"{m}__furuta-hard__{s}" for m in ("nominal", "default_gains") for s in (0, 1)}
    for label, name in (("nominal", "nominal"), ("default gains", "default_gains")):
        files = [out / f"returns/{name}__furuta-hard__{seed}/outcome.json" for seed in (0, 1)]
        outcomes = [json.loads(file.read_text()) for file in files]
        on_rig = [sum(o["returns"]) / len(o["returns"]) for o in outcomes]
        in_simulation = [o["sim_return"] for o in outcomes]
        row = result["rows"][label]
        assert row["return_rig"]["mean"] == pytest.approx(sum(on_rig) / 2)
        assert row["return_sim"]["mean"] == pytest.approx(sum(in_simulation) / 2)
        # The hidden rig is another pendulum than the nominal one.
        assert on_rig != pytest.approx(in_simulation)
    # The same command again takes what is there, and shows it.
    code, text, _ = run(monkeypatch, capsys, *words[:-1])
    assert code == 0 and "default gains" in text
    again = json.loads((out / "table2.json").read_text())
    assert again["rows"] == result["rows"]
