"""Tables of results on the terminal: names, headers and units stay readable at 100 columns."""

from io import StringIO

import pytest
from rich.console import Console

from npdr_ppl.cli import show, show_discovery
from npdr_ppl.cli.printing import broken


@pytest.fixture
def text(monkeypatch):
    """What is printed to a console of 100 columns."""
    text = StringIO()
    for module in (show, show_discovery):
        monkeypatch.setattr(module, "console_for_tables", lambda: Console(file=text, width=100))
    return text


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("shoulder_pan_joint_armature", ["shoulder_pan_", "joint_armature"]),
        ("valve.dead_zone.width", ["valve.dead_", "zone.width"]),
        ("position", ["position"]),
        ("incompressibility", ["incompressibility"]),
        ("", [""]),
    ],
)
def test_a_name_breaks_behind_underscores_and_dots(name, lines):
    assert broken(name, 14).split("\n") == lines


def test_a_fit_says_what_its_errors_are(text, tmp_path):
    name = "shoulder_pan_joint_armature"
    row = {"mean": 0.06669, "sd": 0.0035, "hdi_94": [0.06145, 0.07386]}
    result = {
        "backend": "snpe-c", "parameters": {name: row}, "most_likely": {name: 0.06394},
        "metrics": {"rmse": 0.00158, "dtw": 11.2, "evaluated_on": "held-out"},
        "seconds": {"simulate": 1.0, "train": 2.0, "sample": 3.0},
        "diagnosis": {"decision": "accept", "reason": "Good.", "contraction": {name: 0.85}},
    }  # fmt: skip
    show.show_fit(result, tmp_path)
    assert name in text.getvalue()
    shown = " ".join(text.getvalue().split())
    assert "RMSE 0.00158, DTW 11.2 on held-out rollouts" in shown
    assert "each channel is divided by its largest measured value" in shown


def test_the_headers_of_training_are_whole(text, tmp_path):
    actions = "ran another rollout", "trained the policy on the posterior mixed with the prior"
    decisions = [{"decision": "revise the model", "action": action} for action in actions]
    iteration = {
        "real_returns": [-1404.2, -1300.7], "sim_return": -6111.0, "decisions": decisions,
        "decision": "accept", "reason": "Good.",
    }  # fmt: skip
    show.show_training({"iterations": [iteration]}, tmp_path)
    shown = text.getvalue()
    assert "…" not in shown
    assert shown.count("revise the model") == 2
    for word in ("iteration", "real", "simulated", "return", "decision", "action", actions[0]):
        assert word in " ".join(shown.split()), word
    assert "Simulated return: of the policy trained in this iteration" in " ".join(shown.split())
    assert max(map(len, shown.splitlines())) <= 100


@pytest.mark.parametrize(("unexplained", "is_told"), [(2.8e-5, False), (6e-5, True)])
def test_a_discovery_prints_the_other_parameters(unexplained, is_told, text, tmp_path):
    row = {"mean": 46.09, "sd": 0.027, "hdi_94": [46.04, 46.14], "unit": "kg"}
    effect = {
        "effect": "dead_zone", "port": "valve", "probability": 1.0, "equivalent_to": [],
        "parameters": {"width": {**row, "mean": 0.05, "unit": "1"}},
    }  # fmt: skip
    found = {
        "data_problems": [], "verdict": "named", "reason": "Missing.", "effects": [effect],
        "parameters": {
            "valve.dead_zone.width": row, **{f"mass_{index}": row for index in range(27)}
        },
        "remainder": {"fired": True, "unexplained": unexplained}, "gap": {}, "counts": {},
        "next_experiment": None,
    }  # fmt: skip
    show_discovery.show_discovery(found, tmp_path)
    shown = " ".join(text.getvalue().split())
    assert "mass_24 46.09 0.027 46.04 … 46.14 kg" in shown and "mass_25" not in shown
    assert "2 more parameters are in discovery.json." in shown
    assert shown.count("width") == 1
    assert ("A smaller misfit remains: 0.01%" in shown) is is_told
    assert "0.00%" not in shown
