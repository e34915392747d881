"""What newcomers get wrong in a recording is answered with one sentence that says what to do."""

import json
import math
import sys

import numpy as np
import pytest

from npdr_ppl.cli.main import main

HEADER = "rollout,time,angle,velocity,torque"


def rows():
    """Returns the cells of a pendulum's recording; the last row's torque is empty."""
    time = 0.02 * np.arange(101)
    angle = 0.3 * np.sin(2 * math.pi * time)
    velocity = 0.6 * math.pi * np.cos(2 * math.pi * time)
    torque = [f"{value:.4f}" for value in -np.sin(2 * math.pi * time[:-1])] + [""]
    cells = zip(time, angle, velocity, torque, strict=True)
    return [["0", f"{t:.2f}", f"{a:.5f}", f"{v:.5f}", u] for t, a, v, u in cells]


def column(index, change):
    """Returns a mistake that changes a column's cells."""

    def mistake(header, cells):
        return header, [[*r[:index], change(r[index]), *r[index + 1 :]] for r in cells]

    return mistake


def cell(line, index, text):
    def mistake(header, cells):
        cells[line][index] = text
        return header, cells

    return mistake


def renamed(old, new):
    return lambda header, cells: (header.replace(old, new), cells)


def degrees(text):
    return f"{math.degrees(float(text)):.4f}"


MISTAKES = {
    "wrong names": (renamed("angle,velocity", "q,dq"), "the column angle is missing; the data"),
    "wrong name of time": (renamed("time", "t"), "there is no column time; the header is"),
    "a unit behind time": (renamed("time", "time [s]"), "no part of names, so rename 'time [s]'"),
    "wrong name of an action": (renamed("torque", "tau"), "the column torque is missing"),
    "milliseconds": (column(1, lambda t: f"{1000 * float(t):.0f}"), "is it in milliseconds?"),
    "semicolons": (
        lambda header, cells: (header.replace(",", ";"), [[";".join(r)] for r in cells]),
        "cells are separated by semicolons, but commas are needed",
    ),
    "one column more": (
        lambda header, cells: (header + ",current", [[*r, "1.0" if r[-1] else ""] for r in cells]),
        "the column current is not expected; remove it",
    ),
}  # fmt: skip


FAULTS = {
    "no last row": (lambda header, cells: (header, cells[:-1]), ["used as commands: torque"]),
    "a full last row": (cell(-1, 4, "0.0"), ["used as commands: torque"]),
    "NaN": (cell(50, 2, "NaN"), []),
    "an empty cell": (cell(50, 2, ""), []),
    "irregular time": (cell(50, 1, "1.007"), ["Time stamps are uneven"]),
    "degrees": (column(2, degrees), ["angle looks recorded in degrees"]),
}  # fmt: skip


def answered(monkeypatch, capsys, *words):
    """Runs the command line; returns its exit code and what it said on standard error."""
    monkeypatch.setattr(sys, "argv", ["npdr", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code, capsys.readouterr().err


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_a_recording(monkeypatch, capsys, tmp_path, name):
    mistake, sentence = MISTAKES[name]
    header, cells = mistake(HEADER, rows())
    data = tmp_path / "measured.csv"
    data.write_text("\n".join([header, *map(",".join, cells)]) + "\n")
    code, err = answered(
        monkeypatch, capsys, "fit", "pendulum", "--data", data, "--out", tmp_path / "fit",
        "--backend", "abc", "--rounds", 1, "--simulations", 10, "--segment-length", 25,
    )  # fmt: skip
    assert code == 2
    assert sentence in err
    assert err.startswith("npdr: ") and err.count("\n") == 1, err
    assert not (tmp_path / "fit").exists()


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_a_recording_is_repaired_and_said(monkeypatch, capsys, tmp_path, name):
    fault, notes = FAULTS[name]
    header, cells = fault(HEADER, rows())
    data, out = tmp_path / "measured.csv", tmp_path / "found"
    data.write_text("\n".join([header, *map(",".join, cells)]) + "\n")
    words = ["discover", "pendulum", "--data", data, "--segment-length", 10, "--stage", "check"]
    code, err = answered(monkeypatch, capsys, *words, "--out", out)
    assert code == 0, err
    found = json.loads((out / "discovery.json").read_text())
    told = [*found["data_problems"], *found["remarks"]]
    assert len(told) == len(notes), told
    assert all(expected in note for expected, note in zip(notes, told, strict=True))
    if name == "degrees":
        code, err = answered(monkeypatch, capsys, *words, "--out", tmp_path / "no", "--strict")
        assert code == 2 and err.count("\n") == 1, err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["mine.py"], "add the name of the model in it, as in mine.py:model."),
        (["mine:model"], "did you mean mine.py:model?"),
        (["mine.py:modle"], "Did you mean mine.py:model?"),
        (["mne.py:model"], "mne.py does not exist. Did you mean mine.py:model?"),
        (["arm.xml"], "arm.xml does not exist."),
        (["pendulum", "--effect", "coulomb_friction"], "as in JOINT.coulomb_friction."),
        (["pendulum", "--effect", "hing.coulomb_friction"], "did you mean 'hinge'?"),
        (["pendulum", "--embedding", "bayesim"], "did you mean 'bayessim'?"),
        (["pendulum", "--holdout", "7"], "has 1, counted from 0, so the last is 0."),
        (["pendulum", "--holdout", "0"], "leaves no rollouts to fit"),
        (["pendulum", "--data", "measurd.csv"], "Did you mean measured.csv?"),
        (["pendulum", "--data", "."], ".: is a directory, but a file is needed."),
        (["pendulum", "--device", "cuda:99"], "--device cuda:99 is not available"),
    ],
)
def test_a_mistake_in_a_command(monkeypatch, capsys, tmp_path, words, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("def model(inputs):\n    return inputs\n")
    (tmp_path / "measured.csv").write_text("\n".join([HEADER, *map(",".join, rows())]) + "\n")
    words = words if "--data" in words else [*words, "--data", "measured.csv"]
    code, err = answered(
        monkeypatch, capsys, "fit", *words, "--out", "fit", "--backend", "abc", "--rounds", 1,
        "--simulations", 10, "--segment-length", 25,
    )  # fmt: skip
    assert code == 2
    assert sentence in err
    assert err.startswith("npdr: ") and err.count("\n") == 1, err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fti"], "No such command 'fti'. Did you mean 'fit'?"),
        (["fit"], "Missing argument 'model'."),
        (["fit", "pendulum"], "Missing option '--data'"),
        (
            ["fit", "pendulum", "--roundz", "3"],
            "No such option: --roundz (Possible options: --extra-rounds, --out, --rounds).",
        ),
        (
            ["fit", "pendulum", "--rounds", "many"],
            "Invalid value for '--rounds': Input should be a valid integer",
        ),
        (["fit", "pendulum", "--rounds", "0"], "Invalid value for '--rounds': "),
        (["fit", "pendulum", "--segment-length"], "requires an argument."),
        (
            ["fit", "pendulum", "--data", "a.csv", "b.csv", "--out", "fit"],
            "extra argument(s) (b.csv). Give --data before each of its values.",
        ),
    ],
)
def test_a_mistake_in_an_option(monkeypatch, capsys, words, sentence):
    code, err = answered(monkeypatch, capsys, *words)
    assert code == 2
    assert sentence in err
    assert err.startswith("npdr: ") and err.count("\n") == 1, err


@pytest.mark.slow
def test_the_same_command_works_once_the_recording_is_repaired(monkeypatch, capsys, tmp_path):
    data, out = tmp_path / "measured.csv", tmp_path / "found"
    words = ["discover", "pendulum", "--data", data, "--out", out, "--stage", "check"]
    words += ["--segment-length", 10]
    data.write_text("\n".join([HEADER.replace("angle,velocity", "q,dq"), *map(",".join, rows())]))
    code, err = answered(monkeypatch, capsys, *words)
    assert code == 2 and "the column angle is missing; the data have q, dq" in err
    data.write_text("\n".join([HEADER, *map(",".join, rows())]))
    code, err = answered(monkeypatch, capsys, *words)
    assert code == 0, err
    data.write_text("\n".join([HEADER, *map(",".join, rows()[:51])]))
    code, err = answered(monkeypatch, capsys, *words)
    assert code == 2 and "differs in" in err, "results of another recording are not overwritten"


@pytest.mark.slow
def test_results_cannot_go_into_a_file(monkeypatch, capsys, tmp_path):
    data = tmp_path / "measured.csv"
    data.write_text("\n".join([HEADER, *map(",".join, rows())]))
    for command in ("fit", "discover"):
        code, err = answered(
            monkeypatch, capsys, command, "pendulum", "--data", data, "--out", data / "run"
        )
        assert code == 2
        assert f"cannot be a folder for results: {data} is a file." in err


def test_an_actuator_does_not_hide_the_force_port_of_its_joint(tmp_path):
    from npdr_ppl.engines.mujoco import MujocoSimulator

    # The actuator has the name that a joint's force port gets where the joint's own is taken.
    (tmp_path / "rod.xml").write_text(
        "<mujoco><worldbody><body><joint name='elbow'/><geom size='0.1' mass='1'/></body>"
        "</worldbody><actuator><motor name='elbow_torque' joint='elbow'/></actuator></mujoco>"
    )
    rod = MujocoSimulator(tmp_path / "rod.xml")
    assert rod.port("elbow_torque").kind == "action"
    assert rod.port("elbow_torque_at_joint").kind == "force"
