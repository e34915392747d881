"""Which signal is which channel: names, units, signs, and the sentences for what is wrong."""

import math

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import Log, Mapping, Signal, read_log
from npdr_ppl.rollouts.logs.formats.time_stamps import guessed_unit, in_seconds, time_name
from npdr_ppl.rollouts.logs.units import closest_unit, is_known, si_unit
from npdr_ppl.rollouts.notes import Remark, faults_among, remarks_among

TIME = 0.25 * np.arange(9)


def log(unit=""):
    signals = [Signal("/arm/position", TIME, np.arange(9.0), unit)]
    signals.append(Signal("/arm/velocity", TIME, np.ones(9)))
    return Log("x.mcap", tuple(signals))


def test_units_signs_and_offsets():
    entry = {"signal": "/arm/position", "unit": "deg", "sign": -1, "scale": 2.0, "offset": 0.1}
    rollouts = Rollouts.of(Mapping.of({"channels": {"angle": entry}}).apply(log()))
    expected = -2.0 * np.deg2rad(np.arange(9.0)) + 0.1
    np.testing.assert_allclose(rollouts.readings[0][:, 0], expected, rtol=1e-14)
    assert rollouts.channel_units == ("rad",)
    assert rollouts.action_names == ()


def test_a_signal_that_is_two_channels_is_told():
    twice = {name: {"signal": "/arm/position"} for name in ("angle", "velocity")}
    (note,) = remarks_among(Mapping.of({"channels": twice}).apply(log()).notes)
    assert note == "angle and velocity are the same signal of the log, /arm/position."


def test_whole_turns_are_subtracted():
    turned = Signal("/arm/position", TIME, np.linspace(30.0, 50.0, 9), "rad")
    entry = {"signal": "/arm/position", "first_turn": True, "offset": 0.5}

    def angles(log):
        mapping = Mapping.of({"channels": {"angle": entry}})
        return Rollouts.of(mapping.apply(log)).readings[0][:, 0]

    found = angles(Log("x.mcap", (turned,)))
    assert abs(found[0]) <= np.pi
    assert (30.5 - found[0]) / (2.0 * np.pi) == pytest.approx(5)
    np.testing.assert_allclose(np.diff(found), 2.5, rtol=1e-12)
    with pytest.raises(DataError, match="first_turn of angle needs an angle"):
        angles(log("mm"))
    with pytest.raises(DataError, match="first_turn of goal is for measured angles"):
        Mapping.of({"channels": {"angle": entry}, "actions": {"goal": entry}})


def test_the_logs_own_unit_is_converted_and_an_unknown_one_is_kept():
    plain = Mapping.of({"channels": {"angle": {"signal": "/arm/position"}}})
    assert plain.apply(log("mm")).channel_units == ("m",)
    assert plain.apply(log("mm")).readings[0][-1, 0] == pytest.approx(0.008)
    assert plain.apply(log("ticks")).channel_units == ("ticks",)
    assert plain.apply(log("ticks")).readings[0][-1, 0] == 8.0


@pytest.mark.parametrize(
    ("unit", "factor", "name"),
    [
        ("deg", math.pi / 180, "rad"), ("°/s", math.pi / 180, "rad/s"),
        ("rpm", math.pi / 30, "rad/s"),
        ("mm", 1e-3, "m"), ("cm", 1e-2, "m"), ("mm/s", 1e-3, "m/s"), ("g", 1e-3, "kg"),
        ("mA", 1e-3, "A"), ("mV", 1e-3, "V"), ("mNm", 1e-3, "N m"), ("N m", 1.0, "N m"),
        ("N*m", 1.0, "N m"), ("percent", 1e-2, "1"), ("m/s²", 1.0, "m/s^2"), ("µm", 1e-6, "m"),
        ("furlong", 1.0, "furlong"), ("", 1.0, ""), ("m/s**2", 1.0, "m/s^2"),
        ("rad/sec", 1.0, "rad/s"), ("deg/sec2", math.pi / 180, "rad/s^2"), ("msec", 1e-3, "s"),
    ],
)  # fmt: skip
def test_units(unit, factor, name):
    found = si_unit(unit)
    assert found == (pytest.approx(factor, rel=1e-15), name)


@pytest.mark.parametrize(
    ("unit", "close"),
    [
        ("degs", "deg"), ("Newton metre", "N m"), ("radians", "rad"), ("meters", "m"),
        ("milimeter", "mm"), ("rmp", ""), ("furlong", ""), ("volts", "V"),
    ],
)  # fmt: skip
def test_the_closest_unit_to_one_that_is_not_known(unit, close):
    assert closest_unit(unit) == close and not is_known(unit)


def test_what_the_reader_guessed_is_kept():
    source = Log("x.csv", log().signals, (Remark("time is 't', taken as s."), "the file is cut."))
    notes = Mapping.of(mapping_of("/arm/position")).apply(source).notes
    assert notes == source.notes
    assert faults_among(notes) == ("the file is cut.",)
    assert remarks_among(notes) == ("time is 't', taken as s.",)


def test_units_that_are_likely_mistakes_are_said_once():
    entries = {
        "angle": {"signal": "/arm/position", "unit": "degs"},
        "rate": {"signal": "/arm/velocity", "unit": "degs"},
    }
    (note,) = Mapping.of({"channels": entries}).apply(log()).notes
    assert note == (
        "The unit 'degs' of 'angle, rate' is not known, so values are not converted; did you mean "
        "deg?"
    )
    entries = {"angle": {**entries["angle"], "unit": "deg"}, "rate": {"signal": "/arm/velocity"}}
    (note,) = Mapping.of({"channels": entries}).apply(log()).notes
    assert note.startswith("'rate': no unit is stated, so SI is assumed, but 'angle' is in deg")
    assert not faults_among([note])
    entries["rate"]["unit"] = "rad/s"
    assert not Mapping.of({"channels": entries}).apply(log()).notes


def test_several_logs_are_read_in_one_call(tmp_path):
    for name, step in (("a.csv", 0.01), ("b.csv", 0.02)):
        time = step * np.arange(100)
        pd.DataFrame({"t": time, "x": np.sin(time)}).to_csv(tmp_path / name, index=False)
    paths = [tmp_path / "a.csv", str(tmp_path / "b.csv")]
    both = Rollouts.load(paths, mapping_of("x"))
    assert len(both) == 2 and both.time_step == pytest.approx(0.01)
    assert Rollouts.load(paths[:1], mapping_of("x")) == Rollouts.load(paths[0], mapping_of("x"))
    both.to_csv(tmp_path / "r.csv")
    assert len(Rollouts.load((tmp_path / "r.csv", tmp_path / "r.csv"))) == 4
    with pytest.raises(DataError, match="at least one is needed"):
        Rollouts.load([])
    for wrong in (3, [3], None):
        with pytest.raises(DataError, match="takes a path or a list of paths"):
            Rollouts.load(wrong)


def test_bags_of_ros_1_name_the_converter(tmp_path):
    (tmp_path / "x.bag").write_bytes(b"#ROSBAG V2.0\n")
    for mapping in (None, mapping_of("x")):
        with pytest.raises(DataError, match="x.bag: .*rosbags-convert --src"):
            Rollouts.load(tmp_path / "x.bag", mapping)


def test_mappings_are_written_and_read_back(tmp_path):
    entry = {"signal": 'a "b"\\\n\x1b', "unit": "deg", "sign": -1, "offset": 1e-7}
    content = {
        "log": {"time": "t", "time_unit": "us", "header": False, "time_step": 0.002},
        "channels": {"angle": entry, "α β": {"signal": "x"}},
        "actions": {"voltage": {"signal": "u"}},
    }
    mapping = Mapping.of(content)
    mapping.write(tmp_path / "m.toml")
    assert Mapping.of(tmp_path / "m.toml") == mapping
    assert Mapping.of(str(tmp_path / "m.toml")).channels["angle"].signal == entry["signal"]
    assert Mapping.of(mapping) is mapping


WRONG = {
    "[chanels.x]\nsignal='a'": "the mapping has no key 'chanels'; did you mean 'channels'?",
    "[channels.x]\nsingal='a'": "[channels.x] has no key 'singal'; did you mean 'signal'?",
    "[log]\ntime_units='s'": "[log] has no key 'time_units'; did you mean 'time_unit'?",
    "[log]\ntime_unit='h'": "time_unit",
    "[channels]\nx='a'": "'x' in [channels] should be a table such as [channels.x]",
    "[channels.x]\nunit='m'": "missing required field `signal`",
    "[channels.x]\nsignal='a'\nsign=2": "sign of x is 2, but it should be 1 or -1.",
    "[channels.x]\nsignal='a'\noffset=nan": "offset of x is nan",
    "[channels.x]\nsignal='a'\nscale=0": "scale of x is 0",
    "[channels.x]\nsignal='a'\n[actions.x]\nsignal='b'": "the column 'x' appears twice.",
    "[channels.'a/b']\nsignal='a'": "names begin with a letter",
    "[log]\ntime_step=-1": "time_step is -1.0 s",
    "[channels.x": "it is not valid TOML",
    "x = " + "[" * 5000: "",
}


@pytest.mark.parametrize("text", WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_with_a_mapping_is_said_in_one_sentence(text, tmp_path):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(DataError) as error:
        Mapping.of(tmp_path / "m.toml")
    assert str(error.value).startswith("m.toml: ") and WRONG[text] in str(error.value)
    assert str(error.value).endswith((".", "?")) and str(error.value).isprintable()


def test_missing_signals_are_answered_with_the_closest_names():
    mapping = Mapping.of({"channels": {"angle": {"signal": "/arm/positon"}}})
    with pytest.raises(DataError, match=r"no signal '/arm/positon'; did you mean '/arm/position'"):
        mapping.apply(log())
    with pytest.raises(DataError, match=r"x.mcap: the mapping has no channels"):
        Mapping().apply(log())
    with pytest.raises(DataError, match="no signal 'lap'"):
        Mapping.of(mapping_of("/arm/position", episodes="lap")).apply(log())
    with pytest.raises(DataError, match="not a list"):
        Mapping.of([])


def mapping_of(signal, **log):
    return {"log": log, "channels": {"angle": {"signal": signal}}}


def test_a_log_needs_a_mapping(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"x")
    with pytest.raises(DataError, match="run `npdr inspect LOG --write mapping.toml`"):
        Rollouts.load(tmp_path / "x.mcap")
    with pytest.raises(DataError, match="cannot be opened"):
        Rollouts.load(tmp_path / "y.mcap")
    with pytest.raises(DataError, match="run npdr inspect"):
        (tmp_path / "z.csv").write_text("t,angle\n0,1\n1,2\n")
        Rollouts.load(tmp_path / "z.csv")


# -- Time ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (["x", "timestamp"], "timestamp"),
        (["__time", "/a/header/stamp", "/a/x"], "__time"),
        (["Time (ms)", "x"], "Time (ms)"),
        (["time_us", "x"], "time_us"),
        (["TS_ms", "x"], "TS_ms"),
        (["Ts", "x"], None),
        (["/a/header/stamp", "x"], "/a/header/stamp"),
        (["/a/header/stamp", "/b/header/stamp"], None),
        (["x", "T"], "T"),
        (["tilt", "x"], None),
    ],
)
def test_the_name_of_the_time(names, chosen):
    assert time_name(names) == chosen


@pytest.mark.parametrize(
    ("name", "step", "begin", "unit"),
    [
        ("t", 0.002, 0.0, "s"), ("t", 2.0, 0.0, "ms"), ("t", 20_057.0, 6.7, "us"),
        ("t", 2e6, 0.0, "ns"), ("t", 2e6, 1.7e18, "ns"), ("t", 2e3, 1.7e15, "us"),
        ("t", 2.0, 1.7e12, "ms"), ("t", 0.002, 1.7e9, "s"), ("time_ms", 0.5, 0.0, "ms"),
        ("Time [us]", 1.0, 0.0, "us"),
    ],
)  # fmt: skip
def test_the_unit_of_the_time(name, step, begin, unit):
    assert guessed_unit(name, begin + step * np.arange(50)) == unit


def test_nanoseconds_keep_every_digit():
    ticks = 1_707_681_595_547_459_602 + 1_999_999 * np.arange(1000)
    exact = np.array([int(t) / 10**9 for t in ticks])
    np.testing.assert_array_equal(in_seconds(ticks, 10**9), exact)


def test_dates_and_messages_with_stamps_in_two_parts(tmp_path):
    rows = ["header.stamp.sec,header.stamp.nanosec,x"]
    rows += [f"1700000000,{k * 10**7},{k}" for k in range(9)]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    parts = read_log(tmp_path / "a.csv").by_name["x"].time
    rows = ["date_time;x", *(f"2023-11-14 22:13:20.{k:02d}0;{k}" for k in range(9))]
    (tmp_path / "b.csv").write_text("\n".join(rows).replace("date_time", "datetime"))
    dates = read_log(tmp_path / "b.csv").by_name["x"].time
    np.testing.assert_allclose(dates, parts, atol=1e-6)


def test_tables_without_time_need_a_time_step(tmp_path):
    (tmp_path / "x.csv").write_text("a,b\n" + "1,2\n3,4\n5,6\n")
    with pytest.raises(DataError, match="like time stamps; the columns are 'a, b'"):
        read_log(tmp_path / "x.csv")
    rollouts = Rollouts.load(tmp_path / "x.csv", mapping_of("a", time_step=0.5))
    assert rollouts.time_step == 0.5
    with pytest.raises(DataError, match="no column 'tiem'; did you mean 'time'"):
        Rollouts.from_dataframe(
            pd.DataFrame({"time": TIME, "a": TIME}), mapping_of("a", time="tiem")
        )


def test_episodes_become_rollouts_though_their_time_begins_anew():
    frame = pd.DataFrame({"lap": [0] * 9 + [1] * 9, "t": [*TIME, *TIME], "a": np.arange(18.0)})
    chosen = mapping_of("a", episodes="lap")
    rollouts = Rollouts.from_dataframe(frame, chosen)
    assert len(rollouts) == 2
    assert [part.readings[0][0, 0] for part in rollouts] == [0.0, 9.0]
    # Columns with usual names are found without being named.
    del chosen["log"]["episodes"]
    assert len(Rollouts.from_dataframe(frame.rename(columns={"lap": "episode"}), chosen)) == 2


def laps(**columns):
    """A table in which the time begins anew at row 9."""
    lap = [3] * 9 + [4] * 9
    return pd.DataFrame({"lap": lap, "t": [*TIME, *TIME], "a": np.arange(18.0)} | columns)


def num_rollouts(frame, **log):
    return len(Rollouts.from_dataframe(frame, mapping_of("a", **log)))


def test_a_column_that_counts_up_as_the_time_begins_anew_marks_rollouts():
    rollouts = Rollouts.from_dataframe(laps(), mapping_of("a"))
    assert len(rollouts) == 2
    assert any("the time begins anew whenever 'lap' increases" in note for note in rollouts.notes)
    assert num_rollouts(laps(), episodes="") == 1
    # A cell, or the first time stamp of a lap, may be missing.
    assert num_rollouts(laps(lap=[3] * 4 + [np.nan] + [3] * 4 + [4] * 9)) == 2
    assert num_rollouts(laps(t=[*TIME, np.nan, *TIME[1:]])) == 2
    # Two samples that changed places do not begin anew.
    swapped = [*TIME[:3], TIME[4], TIME[3], *TIME[5:]]
    assert num_rollouts(laps(t=[*TIME, *swapped])) == 2


@pytest.mark.parametrize(
    "columns",
    [
        {"lap": [3] * 8 + [4] * 10},
        {"lap": [3] * 5 + [4] * 4 + [5] * 9},
        {"lap": [3] * 9 + [3.5] * 9},
        {"lap": [4] * 9 + [3] * 9},
        {"t": [*TIME, *(TIME + TIME[-1] + 1.0)]},
        {"lap": np.arange(18), "t": np.arange(18)[::-1]},
    ],
    ids=["elsewhere", "twice", "half", "down", "later", "descending"],
)
def test_other_columns_do_not_mark_rollouts(columns):
    assert num_rollouts(laps(**columns)) == 1


def test_a_command_for_each_rollout_is_no_counter(tmp_path):
    frame = laps().rename(columns={"lap": "voltage", "a": "position"}).assign(trial=laps().lap)
    frame.to_csv(tmp_path / "steps.csv", index=False)
    assert read_log(tmp_path / "steps.csv").episodes == "trial"


def test_words_for_missing_values(tmp_path):
    (tmp_path / "x.csv").write_text("t,a,b\n0,1,nan\n1,NaN,inf\n2,,-Inf\n3,4,2\n4,N/A,true\n")
    signals = read_log(tmp_path / "x.csv").by_name
    assert signals["a"].values.tolist() == [1.0, 4.0]
    assert signals["b"].values.tolist() == [2.0, 1.0]


def test_stamps_of_messages_go_on_with_the_time_of_their_table(tmp_path):
    frame = laps().rename(columns={"a": "imu/x"})
    frame["imu/header/stamp"] = frame.t + 0.001
    frame.to_csv(tmp_path / "log.csv", index=False)
    rollouts = Rollouts.load(tmp_path / "log.csv", mapping_of("imu/x"))
    assert [part.readings[0][0, 0] for part in rollouts] == [0.0, 9.0]
    assert [len(part.readings[0]) for part in rollouts] == [9, 9]
