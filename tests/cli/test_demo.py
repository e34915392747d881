"""`npdr demo`: what it prints and writes."""

import functools
import json
import sys

import pytest

from npdr_ppl.cli import main as cli
from npdr_ppl.workflows import demo
from tests.workflows.small_demo import NUM_STEPS, OPTIONS


def run(monkeypatch, capsys, *words):
    """Runs the command line in this process; returns exit code, output and error text."""
    small = functools.partial(demo.run_demo, options=OPTIONS, num_steps=NUM_STEPS)
    with monkeypatch.context() as context:
        context.setattr(demo, "run_demo", small)
        context.setattr(sys, "argv", ["npdr", "demo", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    out, err = capsys.readouterr()
    return stop.value.code or 0, out, err


def test_the_story_is_printed_written_and_told_again(monkeypatch, capsys, tmp_path):
    out = tmp_path / "demo"
    code, text, err = run(monkeypatch, capsys, "--out", out)
    assert code == 0, err
    for words in ("policy from the prior earns", "revise the model", "sensor_low_pass at"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 100
    for name in ("demo.json", "train.json", "report.html", "learning_curve.png", "rollouts.png"):
        assert (out / name).stat().st_size > 500
    first = json.loads((out / "demo.json").read_text())
    # The same command again runs nothing again.
    code, text, _ = run(monkeypatch, capsys, "--out", out, "--json", "--quiet")
    assert code == 0
    assert json.loads(text)["returns"] == first["returns"]
