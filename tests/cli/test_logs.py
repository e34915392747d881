"""`npdr inspect` and `npdr convert`: from a log to rollouts, with a mapping that it writes."""

import json

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.cli.resolve import load_all
from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import Mapping
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
    assert "largest gap 120 ms at 1.99 s; 1 steps lack samples" in out
    assert "300 samples from 0 to 3.1 s, 100 Hz" in out and "50 Hz" in out
    (line,) = (line for line in lines if "arm/position" in line)
    assert line.split()[1:] == ["0", "…", "1", "position?"]
    assert "velocity?" in out and "command?" in out and "always 0" in out
    assert "'/motor/word'" in out and "taken as s" in out


def test_inspect_as_json(monkeypatch, capsys, log):
    code, out, _ = run(monkeypatch, capsys, "inspect", log, "--json")
    content = json.loads(out)
    assert code == 0 and content["timings"][0]["largest"] == pytest.approx(0.12, abs=1e-5)


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
        ("state_motor/torques/Jaw", "other"),
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
