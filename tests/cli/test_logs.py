"""`npdr inspect` and `npdr convert`: from a log to rollouts, with a mapping that it writes."""

import json

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.cli.resolve import load_all
from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import Log, Mapping, Signal
from npdr_ppl.rollouts.logs.inspection import described
from npdr_ppl.rollouts.logs.signal_names import plain_names, role_of
from tests.helpers.command_line import run


@pytest.fixture
def log(tmp_path):
    """A log with a gap of 0.12 s, as ROS exports it."""
    time = 0.01 * np.arange(300)
    time[200:] += 0.11
    frame = pd.DataFrame({"timestamp": 1_700_000_000 + time})
    frame["/joint_states/arm/position"] = np.sin(time)
    frame["/joint_states/arm/velocity"] = np.cos(time)
    frame["/joint_states/arm/effort"] = 0.0
    frame["/joint_states/a_joint_with_a_very_long_name_of_more/position_deg"] = np.cos(time)
    frame["/motor/voltage_command"] = np.where(np.arange(300) % 2, np.nan, np.sin(time))
    frame["/motor/blob"] = time**2
    frame["/motor/word"] = "text"
    path = tmp_path / "log.csv"
    frame.to_csv(path, index=False)
    return path


def test_inspect_shows_rates_gaps_and_ranges(monkeypatch, capsys, log):
    code, out, err = run(monkeypatch, capsys, "inspect", log)
    assert code == 0 and not err
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "largest gap 120 ms at 1.99 s; gaps of at least 2 steps: 1" in out
    assert "300 samples from 0 to 3.1 s, 100 Hz" in out and "50 Hz" in out
    (line,) = (line for line in lines if "arm/position" in line)
    assert line.split()[1:] == ["0", "…", "1", "position?"]
    assert "velocity?" in out and "command?" in out and "always 0" in out
    assert "'/motor/word'" in out and "taken as s" in out


def test_inspect_as_json(monkeypatch, capsys, log):
    code, out, _ = run(monkeypatch, capsys, "inspect", log, "--json")
    content = json.loads(out)
    assert code == 0 and content["timings"][0]["largest"] == pytest.approx(0.12, abs=1e-5)


def test_a_mapping_for_a_model_names_its_columns(monkeypatch, capsys, tmp_path):
    time = 0.02 * np.arange(100)
    frame = pd.DataFrame({"time": time, "q_measured": np.sin(time), "dq_measured": np.cos(time)})
    frame["torque_command"], frame["temperature"] = np.sin(3 * time), 20 + time
    log, toml = tmp_path / "log.csv", tmp_path / "mapping.toml"
    frame.to_csv(log, index=False)
    words = ["inspect", log, "--model", "pendulum"]
    code, _, err = run(monkeypatch, capsys, *words)
    assert code == 2 and "--write" in err
    code, out, _ = run(monkeypatch, capsys, *words, "--write", toml)
    assert code == 0 and f"npdr fit pendulum --data {log} --mapping {toml}" in out
    assert "#   temperature" in toml.read_text()
    rollouts = load_all([log], toml)
    assert rollouts.channel_names == ("angle", "velocity")
    assert rollouts.action_names == ("torque",)
    assert '# unit = "rad/s"' in toml.read_text()


def test_a_mapping_for_a_model_says_what_the_log_lacks(monkeypatch, capsys, tmp_path):
    """Also of joints whose names are no plain keys of TOML, in the order of the log."""
    robot = tmp_path / "robot.xml"
    joints = ["left hip", "a.b", "knee"]
    hinges = "".join(
        f'<body><joint name="{name}" axis="0 1 0"/><geom size="1" mass="1" pos="1 0 0"/></body>'
        for name in joints
    )
    robot.write_text(f"<mujoco><worldbody>{hinges}</worldbody></mujoco>")
    time = 0.02 * np.arange(100)
    frame = pd.DataFrame(
        {"time": time} | {f"pos_{n}": np.sin(time + k) for k, n in enumerate("xyz")}
    )
    frame.loc[5, "pos_y"] = np.nan
    log, toml = tmp_path / "log.csv", tmp_path / "mapping.toml"
    frame.to_csv(log, index=False)
    words = "inspect", log, "--model", robot, "--write", toml
    code, out, err = run(monkeypatch, capsys, *words)
    assert code == 0, err
    assert "No signal was found" not in out
    mapping = Mapping.of(toml)
    assert {n: mapping.channels[n].signal for n in joints} == dict(
        zip(joints, ("pos_x", "pos_y", "pos_z"), strict=True)
    )
    frame.drop(columns="pos_z").to_csv(log, index=False)
    toml.unlink()
    out = run(monkeypatch, capsys, *words)[1]
    assert "No signal was found for left hip, a.b, knee.\nAdd what is missing, " in out


@pytest.mark.parametrize(
    "body", ["inputs.actions[..., 0].sum()", "inputs.channel_names.index('angle')"]
)
def test_a_model_that_needs_a_recording_gets_a_sentence(monkeypatch, capsys, tmp_path, log, body):
    (tmp_path / "model.py").write_text(
        "import npdr_ppl as npdr\nfrom npdr_ppl.models.pendulum import pendulum\n"
        f"def model(inputs):\n    {body}\n    return pendulum(inputs)\n"
    )
    words = "inspect", log, "--model", f"{tmp_path / 'model.py'}:model", "--write"
    code, _, err = run(monkeypatch, capsys, *words, tmp_path / "m.toml")
    assert code == 2 and "without a recording" in err


def test_the_mapping_that_is_written_converts_the_log(monkeypatch, capsys, log, tmp_path):
    toml = tmp_path / "mapping.toml"
    code, out, _ = run(monkeypatch, capsys, "inspect", log, "--write", toml)
    assert code == 0 and f"--mapping {toml}" in out
    text = toml.read_text()
    mapping = Mapping.of(toml)
    degrees = "/joint_states/a_joint_with_a_very_long_name_of_more/position_deg"
    assert [e.signal for e in mapping.channels.values()] == [
        "/joint_states/arm/position",
        "/joint_states/arm/velocity",
        degrees,
    ]
    assert [e.signal for e in mapping.actions.values()] == ["/motor/voltage_command"]
    assert "# does not change:" in text and "# meaning not clear from its name:" in text
    assert 'unit = "deg"' in text
    code, _, err = run(monkeypatch, capsys, "inspect", log, "--write", toml)
    assert code == 2 and "exists already" in err
    code, out, _ = run(monkeypatch, capsys, "inspect", log, "--mapping", toml)
    assert code == 0 and "Rollouts(" in out

    rollouts = tmp_path / "rollouts.parquet"
    code, out, _ = run(
        monkeypatch, capsys, "convert", log, log, "--mapping", toml, "--out", rollouts
    )
    assert code == 0
    single = Rollouts.load(log, toml)
    both = Rollouts.load(rollouts)
    assert len(both) == 2 * len(single)
    assert both.channel_names == single.channel_names


def test_what_goes_wrong_is_one_sentence(monkeypatch, capsys, log, tmp_path):
    for words, sentence in (
        (["convert", log, "--out", "x.txt"], "--out should end in .parquet, .csv, .npz, .nc"),
        (["inspect", tmp_path / "lag.csv"], "Did you mean"),
        (["inspect", tmp_path / "log.xyz"], "cannot be opened"),
        (["fit", "pendulum", "--data", log, "--out", tmp_path / "f"], "run npdr inspect"),
        (["inspect", log, "--mapping", log], "it is not valid TOML"),
    ):
        code, _, err = run(monkeypatch, capsys, *words)
        assert code == 2 and sentence in err and err.count("\n") == 1, err


def test_logs_whose_clocks_differ_a_little_are_joined(tmp_path):
    paths = []
    for index, step in enumerate((0.01, 0.01003)):
        time = step * np.arange(100)
        pd.DataFrame({"t": time, "a": np.sin(time)}).to_csv(tmp_path / f"{index}.csv")
        paths.append(tmp_path / f"{index}.csv")
    toml = tmp_path / "m.toml"
    toml.write_text("[channels.angle]\nsignal = 'a'\n")
    joined = load_all(paths[:2], toml)
    assert len(joined) == 2 and joined.time_step == pytest.approx(0.01, rel=1e-9)
    # Both cover the same time, though the second clock is slower.
    assert abs(joined.time[1][-1] - 0.01003 * 99) < 0.02
    with pytest.raises(DataError, match="cannot be opened"):
        load_all([paths[0], tmp_path / "missing.csv"], toml)


@pytest.fixture
def driven(tmp_path):
    """A log in German with a torque, which may be the command."""
    time = 0.01 * np.arange(100)
    frame = pd.DataFrame({"Zeit": time, "winkel_deg": 50.0 * np.sin(time)})
    frame["tau"] = np.cos(3.0 * time)
    frame["wort"] = "text"
    frame.to_csv(tmp_path / "zeit.csv", index=False)
    return tmp_path / "zeit.csv"


def test_a_time_that_is_not_recognised_is_named(monkeypatch, capsys, driven, tmp_path):
    toml, other = tmp_path / "mapping.toml", tmp_path / "other.toml"
    code, _, err = run(monkeypatch, capsys, "inspect", driven, "--write", toml)
    assert code == 2 and "npdr inspect LOG --time NAME --write mapping.toml" in err
    code, out, _ = run(monkeypatch, capsys, "inspect", driven, "--time", "Zeit", "--write", toml)
    assert code == 0 and "time is 'Zeit'" in out
    assert Mapping.of(toml).log.time == "Zeit"
    assert Rollouts.load(driven, toml).lengths == (99,)
    # A mapping without channels says how the log is read, too.
    other.write_text('[log]\ntime = "Zeit"\n')
    whole = tmp_path / "whole.toml"
    code, out, _ = run(
        monkeypatch, capsys, "inspect", driven, "--mapping", other, "--write", whole
    )
    assert code == 0 and "other.toml has no channels" in " ".join(out.split())
    assert whole.read_text() == toml.read_text()


def test_rows_without_time_stamps_have_a_time_step(monkeypatch, capsys, tmp_path):
    (tmp_path / "x.csv").write_text("angle\n" + "1\n2\n3\n")
    words = ["inspect", tmp_path / "x.csv", "--write", tmp_path / "m.toml", "--time-step"]
    code, _, err = run(monkeypatch, capsys, *words, "-1")
    assert code == 2 and "time_step is -1.0 s" in err
    code, _, _ = run(monkeypatch, capsys, *words, "0.5")
    assert code == 0 and Rollouts.load(tmp_path / "x.csv", tmp_path / "m.toml").time_step == 0.5


def test_a_torque_is_proposed_as_an_action(monkeypatch, capsys, driven, tmp_path):
    toml = tmp_path / "mapping.toml"
    words = ["inspect", driven, "--time", "Zeit", "--write", toml]
    code, out, _ = run(monkeypatch, capsys, *words)
    assert code == 0 and "effort?" in out
    shown = " ".join(out.split())
    assert "No actions: the motion is taken as free. If tau is a command, remove the #" in shown
    proposed = '# [actions.tau]\n# signal = "tau"\n'
    assert proposed in toml.read_text() and "no actions yet" in toml.read_text()
    toml.write_text(toml.read_text().replace(proposed, proposed.replace("# ", "")))
    assert Rollouts.load(driven, toml).action_names == ("tau",)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("winkel_deg", "deg"), ("winkel [deg]", "deg"), ("rate (deg/s)", "deg/s"),
        ("q [x]", ""), ("(" * 10**6, ""), ("", ""),
    ],
)  # fmt: skip
def test_units_in_names(name, unit):
    signals = (Signal(name, np.arange(3.0), np.arange(3.0)),)
    ((summary,),) = [timing.signals for timing in described(Log("x", signals)).timings]
    assert summary.unit == unit


def test_velocities_without_a_unit_beside_degrees_get_a_remark(monkeypatch, capsys, tmp_path):
    rows = [f"{k / 100},{k},{k * k}" for k in range(50)]
    (tmp_path / "x.csv").write_text("\n".join(["t,joint_pos_deg,joint_vel", *rows]))
    code, out, _ = run(monkeypatch, capsys, "inspect", tmp_path / "x.csv")
    assert code == 0 and "'joint_vel': no unit is stated" in out and "state deg/s if" in out


def test_how_a_log_was_read_is_printed(monkeypatch, capsys, log, driven, tmp_path):
    toml = tmp_path / "mapping.toml"
    toml.write_text(
        "[log]\ntime = 'Zeit'\n[channels.angle]\nsignal = 'winkel_deg'\nunit = 'degs'\n"
    )
    words = ["convert", driven, driven, "--mapping", toml, "--out", tmp_path / "r.csv"]
    code, out, _ = run(monkeypatch, capsys, *words)
    shown = " ".join(out.split())
    for sentence in (
        "time is 'Zeit', taken as s.",
        "text was left out: 'wort'.",
        "The unit 'degs' of 'angle' is not known, so values are not converted; did you mean deg?",
        "No actions: the motion is taken as free.",
    ):
        assert code == 0 and shown.count(sentence) == 1, out
    code, out, _ = run(monkeypatch, capsys, "inspect", driven, "--mapping", toml)
    assert code == 0 and out.count("'degs'") == 1 and out.count("No actions") == 1
    arm = "[channels.arm]\nsignal = '/joint_states/arm/position'\n"
    toml.write_text(arm + "[actions.u]\nsignal = '/motor/voltage_command'\n")
    code, out, _ = run(monkeypatch, capsys, "inspect", log, "--mapping", toml)
    assert code == 0 and "Gaps: " in out and "No actions" not in out


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("/joint_states/arm/position", "position"),
        ("observation.state.arm.pos", "position"),
        ("q_3", "position"),
        ("qd", "velocity"),
        ("imu/angularVelocity/x", "velocity"),
        ("action.arm.pos", "command"),
        ("/effort_control/data.0", "command"),
        ("voltage", "command"),
        ("state_motor/torques/Jaw", "effort"),
        ("tau", "effort"),
        ("/arm/tau_2", "effort"),
        ("current [A]", "effort"),
        ("tau_cmd", "command"),
        ("battery/power", "other"),
        ("pose/covariance.3", "other"),
    ],
)
def test_roles(name, role):
    assert role_of(name) == role


def test_plain_names_differ_and_can_be_stored():
    from npdr_ppl.rollouts.rollout_checks import check_names

    signals = ["/a/x/pos", "/b/x/pos", "/a/b", "a-b", "3", "", "time", "/a/b/", "é/ü"]
    names = plain_names(signals)
    check_names(names)
    assert plain_names(["/joint_states/arm/position", "/u"]) == ["arm_position", "u"]
