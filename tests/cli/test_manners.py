"""How the command line behaves: quick, quiet where asked, colourless where asked, resumable."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import typer

from npdr_ppl.cli.main import app
from npdr_ppl.cli.manners import INTERRUPTED, resumable
from npdr_ppl.rollouts import Rollouts
from tests.helpers.command_line import run

NPDR = [sys.executable, "-m", "npdr_ppl.cli"]
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
WITH_RESULTS = ("demo", "discover", "fit", "compare", "train", "reproduce", "report")


def npdr(*words, **environment):
    return subprocess.run(
        [*NPDR, *map(str, words)],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


@pytest.fixture
def recording(tmp_path):
    seconds = 0.02 * np.arange(101)
    angle = 0.3 * np.sin(2 * np.pi * seconds)
    Rollouts.from_arrays(
        readings=[np.stack([angle, np.gradient(angle, seconds)], -1)],
        actions=[np.sin(2 * np.pi * seconds[:-1])[:, None]],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    ).to_csv(tmp_path / "measured.csv")
    return tmp_path / "measured.csv"


def small_fit(recording, out):
    return [
        "fit", "pendulum", "--data", recording, "--out", out, "--rounds", 1, "--simulations", 20,
        "--backend", "abc", "--embedding", "all/10", "--segment-length", 25,
    ]  # fmt: skip


@pytest.mark.slow
def test_help_is_quick_and_groups_commands():
    took = []
    for _ in range(3):
        before = sum(os.times()[2:4])  # of the processor: other tests run at the same time
        shown = npdr("--help")
        took.append(sum(os.times()[2:4]) - before)
    assert min(took) < 1.0, took
    for group in ("See it work", "Infer parameters", "Train policies", "Show results"):
        assert group in shown.stdout


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_an_example(name):
    assert f"Example: npdr {name}" in (COMMANDS[name].help or "")


@pytest.mark.parametrize("name", WITH_RESULTS)
def test_commands_that_compute_can_be_silent_verbose_or_read_by_machines(name):
    options = {word for parameter in COMMANDS[name].params for word in parameter.opts}
    assert {"--quiet", "-q", "--verbose", "-v", "--json"} <= options


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["fti"], "fit"),
        (["fit", "pendulum", "--dta", "x.csv"], "--data"),
        (["fit", "pendulun", "--data", "x.csv", "--out", "y"], "did you mean 'pendulum'"),
        (["train", "furuta", "--target", "furuta-hrd", "--out", "y"],
         "did you mean 'furuta-hard'"),
        (["train", "furuta", "--target", "furuta-hard", "--out", "y", "--backend", "snpe"],
         "did you mean 'snpe-"),
        (["fit", "pendulum", "--data", "x.csv", "--out", "y", "--effect", "hinge.coulomb"],
         "did you mean 'coulomb_friction'"),
    ],
)  # fmt: skip
def test_a_word_almost_right_gets_a_suggestion(monkeypatch, capsys, words, hint):
    code, _, err = run(monkeypatch, capsys, *words)
    assert code == 2
    assert hint in " ".join(err.replace("│", " ").split())


@pytest.mark.slow
def test_no_color_is_respected():
    coloured = npdr("--help", FORCE_COLOR="1", NO_COLOR="")
    plain = npdr("--help", FORCE_COLOR="1", NO_COLOR="1")
    assert "\x1b[3" in coloured.stdout or "\x1b[1;3" in coloured.stdout
    assert "\x1b[3" not in plain.stdout and "\x1b[1;3" not in plain.stdout


@pytest.mark.slow
def test_completion_is_there_for_the_common_shells():
    for shell in ("bash", "zsh", "fish"):
        shown = npdr("--show-completion", shell, _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
        assert "npdr" in shown.stdout, shown


@pytest.mark.slow
def test_json_quiet_and_verbose(monkeypatch, capsys, recording, tmp_path):
    words = small_fit(recording, tmp_path / "fit")
    first = npdr(*words, "--json", "-v")
    assert first.returncode == 0, first.stderr
    assert json.loads(first.stdout) == json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert "round 1/1: 20 simulations" in first.stderr
    # No bars either: there is no terminal.
    assert run(monkeypatch, capsys, *words, "--quiet") == (0, "", "")


def test_an_interruption_says_how_to_go_on(capsys):
    with pytest.raises(typer.Exit) as stop, resumable("do it again."):
        raise KeyboardInterrupt
    assert stop.value.exit_code == INTERRUPTED
    assert capsys.readouterr().err == "npdr: interrupted; do it again.\n"


@pytest.mark.slow
def test_ctrl_c_leaves_a_run_that_continues(recording, tmp_path):
    out = tmp_path / "fit"
    words = small_fit(recording, out)
    words = [w if w != "abc" else "snpe-c" for w in map(str, words)]
    words[words.index("--simulations") + 1] = "500"
    process = subprocess.Popen(
        [*NPDR, *words],
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in the background, a shell has told them to ignore interrupts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 60
    # Simulations are on disk before training, which takes the longest.
    while not (out / "run" / "round_0_simulations.safetensors").exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED, err
    assert f"npdr: interrupted; the same command again continues the run in {out}." in err
    assert not (out / "fit.json").exists()
