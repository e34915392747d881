"""The same motion, written by each format's own library, reads to exactly the same rollouts."""

import json

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.errors import DataError, DependencyError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import read_log

STEP_NS = 10_000_000
COUNT = 200
NS = 1_700_000_000_000_000_000 + STEP_NS * np.arange(COUNT)
TIME = NS // 10**9 + (NS % 10**9) / 1e9
ANGLE = 30 * np.sin(0.05 * np.arange(COUNT))
RATE = np.gradient(ANGLE, 0.01)
VOLTAGE = np.cos(0.1 * np.arange(COUNT))

TABLE = {"time": TIME, "angle": ANGLE, "rate": RATE, "voltage": VOLTAGE}

PLAIN = {
    "channels": {
        "angle": {"signal": "angle", "unit": "deg"},
        "rate": {"signal": "rate", "unit": "deg/s"},
    },
    "actions": {"voltage": {"signal": "voltage", "unit": "V"}},
}


def mapping(angle, rate, voltage, **log):
    """The plain mapping with other names of the signals."""
    return {
        "log": log,
        "channels": {
            "angle": {"signal": angle, "unit": "deg"},
            "rate": {"signal": rate, "unit": "deg/s"},
        },
        "actions": {"voltage": {"signal": voltage, "unit": "V"}},
    }


def csv_text(separator=",", header=True, comma=False):
    rows = [separator.join(TABLE)] if header else []
    for row in zip(*TABLE.values(), strict=True):
        line = separator.join(repr(float(value)) for value in row)
        rows.append(line.replace(".", ",") if comma else line)
    return "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_text(csv_text())
    rollouts = Rollouts.load(path, PLAIN)
    assert rollouts.channel_units == ("rad", "rad/s") and rollouts.action_units == ("V",)
    np.testing.assert_allclose(rollouts.readings[0][:, 0], np.deg2rad(ANGLE), atol=1e-4)
    np.testing.assert_allclose(rollouts.actions[0][:, 0], VOLTAGE[:-1], atol=1e-2)
    assert rollouts.time_step == pytest.approx(0.01, rel=1e-3)
    return rollouts


@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_separators(separator, expected, tmp_path):
    (tmp_path / "log.csv").write_text(csv_text(separator))
    assert Rollouts.load(tmp_path / "log.csv", PLAIN) == expected


def test_decimal_commas(expected, tmp_path):
    (tmp_path / "log.csv").write_text(csv_text(";", comma=True))
    assert Rollouts.load(tmp_path / "log.csv", PLAIN) == expected


def test_a_table_without_a_header(expected, tmp_path):
    (tmp_path / "log.txt").write_text(csv_text("\t", header=False))
    chosen = mapping("column_1", "column_2", "column_3", time="column_0")
    assert Rollouts.load(tmp_path / "log.txt", chosen) == expected
    # A first column that increases is found to be the time.
    assert len(read_log(tmp_path / "log.txt").signals) == 3


def test_messages_on_rows_of_their_own(expected, tmp_path):
    frame = pd.DataFrame(TABLE)
    commands = frame[["time", "voltage"]]
    states = frame[["time", "angle", "rate"]]
    mixed = pd.concat([commands, states]).sort_values("time", kind="stable")
    mixed["note"] = "text"
    mixed.to_csv(tmp_path / "log.csv", index=False)
    assert Rollouts.load(tmp_path / "log.csv", PLAIN) == expected
    assert any("note" in sentence for sentence in read_log(tmp_path / "log.csv").notes)


def test_data_frames(expected):
    frame = pd.DataFrame(TABLE)
    assert Rollouts.from_dataframe(frame, PLAIN) == expected
    assert Rollouts.from_dataframe(frame.set_index("time"), PLAIN) == expected
    dates = frame.drop(columns="time").set_index(pd.to_datetime(NS))
    assert Rollouts.from_dataframe(dates, PLAIN) == expected
    table = frame.assign(rollout=0, time=0.01 * np.arange(COUNT))
    table.loc[COUNT - 1, "voltage"] = np.nan
    assert Rollouts.from_dataframe(table).action_names == ("voltage",)
    with pytest.raises(DataError, match="data frame is needed, not a list"):
        Rollouts.from_dataframe([1, 2], PLAIN)


def test_parquet(expected, tmp_path):
    frame = pd.DataFrame(TABLE).assign(time=pd.to_datetime(NS), label="text")
    frame["vector"] = [[1.0, 2.0]] * COUNT
    frame.to_parquet(tmp_path / "log.parquet")
    assert Rollouts.load(tmp_path / "log.parquet", PLAIN) == expected
    assert {"vector.0", "vector.1"} <= set(read_log(tmp_path / "log.parquet").by_name)


def test_hdf5(expected, tmp_path):
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["stamps/t"] = [1.0, 2.0, 3.0]
        group = file.create_group("arm")
        group["timestamp"] = TIME
        group["state"] = np.stack([ANGLE, RATE], 1)
        group["state"].attrs["units"] = "deg"
        group.create_dataset("voltage", data=VOLTAGE, compression="gzip", shuffle=True)
        file["note"] = "text"
    chosen = mapping("arm/state.0", "arm/state.1", "arm/voltage")
    assert Rollouts.load(tmp_path / "log.h5", chosen) == expected
    assert read_log(tmp_path / "log.h5").by_name["arm/state.0"].unit == "deg"


@pytest.mark.parametrize("compressed", [True, False])
def test_mat_of_version_5(compressed, expected, tmp_path):
    from scipy.io import savemat

    content = {
        "t": TIME,
        "log": {
            "state": {"angle": ANGLE[:, None], "rate": RATE},
            "words": "text",
            "cells": np.array([1, "a"], dtype=object),
        },
        "voltage": VOLTAGE[None],
        "steps": np.arange(COUNT, dtype=np.int16),
        "z": 1j * ANGLE,
        "is_on": np.ones(COUNT, dtype=bool),
    }
    savemat(tmp_path / "log.mat", content, do_compression=compressed)
    chosen = mapping("log/state/angle", "log/state/rate", "voltage")
    assert Rollouts.load(tmp_path / "log.mat", chosen) == expected
    log = read_log(tmp_path / "log.mat")
    np.testing.assert_array_equal(log.by_name["steps"].values, np.arange(COUNT))
    assert "z" not in log.by_name


def test_mat_of_version_7_3(expected, tmp_path):
    import h5py

    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        for name, values in {**TABLE, "word": np.arange(9)}.items():
            is_text = name == "word"
            file[name] = values[None].astype("u2" if is_text else "f8")  # columns first
            file[name].attrs["MATLAB_class"] = np.bytes_("char" if is_text else "double")
    with (tmp_path / "log.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")
    assert Rollouts.load(tmp_path / "log.mat", PLAIN) == expected
    assert "word" not in read_log(tmp_path / "log.mat").by_name


# -- ROS -------------------------------------------------------------------------------------

JOINTS = ("arm", "pole")
BAG = mapping("/joint_states/arm/position", "/joint_states/arm/velocity", "/voltage/data.0")


def ros_messages():
    """Yields topic, time stamp in ns and content of each message."""
    for index, ns in enumerate(NS.tolist()):
        stamp = {"sec": ns // 10**9, "nanosec": ns % 10**9}
        # Received later, in another order of arrays.
        yield "/joint_states", ns + 400_000, {
            "header": {"stamp": stamp, "frame_id": "base"},
            "name": list(JOINTS),
            "position": [ANGLE[index], 0.5],
            "velocity": [RATE[index], 0.0],
            "effort": [],
        }  # fmt: skip
        layout = {"dim": [], "data_offset": 0}
        yield "/voltage", ns, {"layout": layout, "data": [VOLTAGE[index]]}


TYPES = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/voltage": "std_msgs/msg/Float64MultiArray",
}


def store():
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_mcap_of_ros_2(compression, expected, tmp_path):
    from mcap.writer import CompressionType
    from mcap_ros2.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType[compression], chunk_size=2_000)
        schemas = {
            topic: writer.register_msgdef(kind, store().generate_msgdef(kind, ros_version=2)[0])
            for topic, kind in TYPES.items()
        }
        for topic, ns, message in ros_messages():
            writer.write_message(topic, schemas[topic], message, log_time=ns)
        writer.finish()
    assert Rollouts.load(tmp_path / "log.mcap", BAG) == expected
    log = read_log(tmp_path / "log.mcap")
    assert log.by_name["/joint_states/pole/position"].unit == "rad"
    late = read_log(tmp_path / "log.mcap", _settings(time="log"))
    delay = late.by_name["/joint_states/arm/position"].time - TIME
    np.testing.assert_allclose(delay, 4e-4, atol=1e-6)
    # The recorder was stopped, so the end is missing.
    data = (tmp_path / "log.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    assert any("ends in the middle" in note for note in read_log(tmp_path / "cut.mcap").notes)


def _settings(**values):
    from npdr_ppl.rollouts.logs import LogSettings

    return LogSettings(**values)


def test_mcap_of_json(expected, tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {
            topic: writer.register_channel(topic, "json", writer.register_schema(kind, "", b""))
            for topic, kind in TYPES.items()
        }
        other = writer.register_channel("/image", "protobuf", 0)
        writer.add_message(other, int(NS[0]), b"x", int(NS[0]))
        for topic, ns, message in ros_messages():
            writer.add_message(channels[topic], ns, json.dumps(message).encode(), ns)
        writer.finish()
    assert Rollouts.load(tmp_path / "log.mcap", BAG) == expected
    assert any("/image" in note for note in read_log(tmp_path / "log.mcap").notes)


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("version", [8, 9])
def test_bags_of_ros_2(storage, version, expected, tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    types = store()
    folder = tmp_path / "bag"
    with Writer(folder, version=version, storage_plugin=StoragePlugin[storage]) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=types)
            for topic, kind in TYPES.items()
        }
        for topic, ns, message in ros_messages():
            content = typed(types, TYPES[topic], message)
            data = types.serialize_cdr(content, TYPES[topic])
            writer.write(connections[topic], ns, bytes(data))
    assert Rollouts.load(folder, BAG) == expected
    (file,) = (f for f in folder.iterdir() if f.suffix != ".yaml")
    assert Rollouts.load(file, BAG) == expected


def typed(types, kind, content):
    """Returns the message object of a dictionary."""
    cls = types.types[kind]
    values = {}
    for name, (node, detail) in types.fielddefs[kind][1]:
        value = content[name]
        if node == 2:
            value = typed(types, detail, value)
        elif (
            isinstance(value, list)
            and (not value or isinstance(value[0], float))
            and name != "dim"
        ):
            value = np.array(value, dtype=np.float64)
        values[name] = value
    return cls(**values)


def test_a_missing_library_is_named(monkeypatch, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, "mcap.stream_reader", None)
    (tmp_path / "log.mcap").write_bytes(b"x" * 99)
    with pytest.raises(DependencyError, match=r"pip install npdr-ppl\[logs\]"):
        read_log(tmp_path / "log.mcap")


def test_a_clock_of_its_own_is_noticed(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/state", "json", 0)
        for index, ns in enumerate(NS.tolist()):
            stamp = {"sec": index // 100 + 1, "nanosec": index % 100 * 10**7}
            data = json.dumps({"header": {"stamp": stamp}, "x": index, "long": [0.0] * 500})
            writer.add_message(channel, ns, data.encode(), ns)
        writer.finish()
    log = read_log(tmp_path / "log.mcap")
    np.testing.assert_array_equal(log.by_name["/state/x"].time, TIME)
    assert any("differ from the recorder's clock" in note for note in log.notes)
    assert any("arrays of more than 100 numbers" in note for note in log.notes)


def test_all_types_of_numbers_are_decoded():
    """The decoder agrees with the library's encoder for every type, byte order and nesting."""
    from npdr_ppl.rollouts.logs.formats.ros_messages import decode, definitions, layout

    types = store()
    text = """# a comment
uint8 LIMIT=3  # a constant
string WORD = "a # b"
bool is_on
int8 a
uint16[3] b
wstring w
char c
float32 d
int64[<=4] e
Inner[] inner
builtin_interfaces/Time when
string<=9 word "default"
Empty nothing
uint64 last 7
================================================================================
MSG: pkg/Inner
float64 x
string[] names
================================================================================
MSG: pkg/Empty
"""
    from rosbags.typesys import get_types_from_msg

    # The library has neither texts of two bytes nor bounded ones with comments in the values.
    text = text.replace("wstring w\n", "").replace('string WORD = "a # b"\n', "")
    types.register(get_types_from_msg(text, "pkg/msg/Outer"))
    made = types.types
    time = made["builtin_interfaces/msg/Time"](sec=-3, nanosec=5)
    inner = [made["pkg/msg/Inner"](x=0.5 * k, names=["a" * k]) for k in range(3)]
    message = made["pkg/msg/Outer"](
        is_on=True, a=-5, b=np.array([1, 2, 65535], np.uint16), c=7, d=0.25,
        e=np.array([2**62, -1]), inner=inner, when=time, word="hi",
        nothing=made["pkg/msg/Empty"](), last=2**64 - 1,
    )  # fmt: skip
    expected = {
        "is_on": True, "a": -5, "b": [1, 2, 65535], "c": 7, "d": 0.25, "e": [2**62, -1],
        "inner": [{"x": 0.5 * k, "names": ["a" * k]} for k in range(3)],
        "when": {"sec": -3, "nanosec": 5}, "word": "hi", "nothing": {}, "last": 2**64 - 1,
    }  # fmt: skip
    known = definitions("pkg/msg/Outer", text)
    for is_little in (True, False):
        data = bytes(types.serialize_cdr(message, "pkg/msg/Outer", little_endian=is_little))
        assert decode(data, "pkg/Outer", known)[0] == expected
        alike = layout(data, "pkg/Outer", known)
        assert alike.numbers(data) == (
            True, -5, 1, 2, 65535, 7, 0.25, 2**62, -1, 0.0, 0.5, 1.0, -3, 5, 0, 2**64 - 1
        )  # fmt: skip
        assert alike.places["inner"][1] == {"x": 10, "names": ["a"]}
        other = data.replace(b"hi", b"ho")
        assert other != data and alike.numbers(other) is None


def test_messages_of_one_layout_read_as_each_by_itself(monkeypatch, tmp_path):
    """Arrays that grow and names that change begin a new layout."""
    from mcap_ros2.writer import Writer

    from npdr_ppl.rollouts.logs.formats import bag_logs

    kind = "sensor_msgs/msg/JointState"
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(kind, store().generate_msgdef(kind, ros_version=2)[0])
        for index in range(60):
            num = 1 + index // 10 % 3
            message = {
                "header": {"stamp": {"sec": index, "nanosec": 7 * index}, "frame_id": ""},
                "name": [f"{'ab'[index // 30]}{k}" for k in range(num)],
                "position": [index + 0.1 * k for k in range(num)],
                "velocity": [0.5 * index] * (200 if index == 45 else num), "effort": [],
            }  # fmt: skip
            writer.write_message("/joints", schema, message, log_time=10**9 * index)
        writer.finish()
    quick = read_log(tmp_path / "log.mcap")
    monkeypatch.setattr(bag_logs, "MAX_LAYOUTS", 0)
    each = read_log(tmp_path / "log.mcap")
    assert quick.notes == each.notes and len(quick.signals) == len(each.signals) == 12
    for one, other in zip(quick.signals, each.signals, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.time, other.time)
        np.testing.assert_array_equal(one.values, other.values)


# -- Folders ---------------------------------------------------------------------------------


def write_lerobot(folder, version, *, episodes=2):
    """Writes the motion twice, in the layout of LeRobot."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = []
    for episode in range(episodes):
        vectors = pa.FixedSizeListArray.from_arrays(np.stack([ANGLE, RATE], 1).ravel(), 2)
        commands = pa.array([[v] for v in VOLTAGE.tolist()])
        tables.append(
            pa.table(
                {
                    "observation.state": vectors,
                    "action": commands,
                    "timestamp": 0.01 * np.arange(COUNT),
                    "frame_index": np.arange(COUNT),
                    "episode_index": np.full(COUNT, episode),
                    "index": np.arange(COUNT) + COUNT * episode,
                    "task_index": np.zeros(COUNT, dtype=int),
                }
            )
        )
    names = ["shoulder.pos", "shoulder.vel"]
    features = {
        "observation.state": {"dtype": "float64", "shape": [2], "names": names},
        "action": {"dtype": "float64", "shape": [1], "names": {"motors": ["shoulder.cmd"]}},
        "observation.images.top": {"dtype": "video", "shape": [480, 640, 3], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    info = {"codebase_version": version, "fps": 100, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    if version == "v3.0":
        pq.write_table(
            pa.concat_tables(tables), folder / "data" / "chunk-000" / "file-000.parquet"
        )
    else:
        for episode, table in enumerate(tables):
            pq.write_table(table, folder / "data" / "chunk-000" / f"episode_{episode:06d}.parquet")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot(version, expected, tmp_path):
    write_lerobot(tmp_path / "set", version)
    rollouts = Rollouts.load(tmp_path / "set")
    assert rollouts.channel_names == ("shoulder_pos", "shoulder_vel")
    assert rollouts.action_names == ("shoulder_cmd",)
    assert rollouts.channel_units == ("", "") and "state no units" in rollouts.notes[-1]
    assert len(rollouts) == 2
    for part in rollouts:
        # The values are those of the CSV file, in the degrees that were logged.
        np.testing.assert_allclose(np.deg2rad(part.readings[0]), expected.readings[0], atol=1e-3)
        np.testing.assert_allclose(part.actions[0], expected.actions[0], atol=1e-2)


def test_a_folder_of_csv_files(expected, tmp_path):
    for name, columns in (("state", ["angle", "rate"]), ("command", ["voltage"])):
        rows = [f"type,timestamp,{'values'}"]
        for index in range(COUNT):
            vector = json.dumps([float(TABLE[c][index]) for c in columns])
            rows.append(f'STATE,{int(NS[index]) // 1000},"{vector}"')
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))
    (tmp_path / "list.txt").write_text("angle\nrate\n")
    (tmp_path / "event.csv").write_text("type,timestamp,event\nEVENT,0,START\n")
    chosen = mapping("state/values/angle", "state/values/rate", "command/values")
    names = read_log(tmp_path).by_name
    assert set(names) == {"state/values/angle", "state/values/rate", "command/values.0"}
    chosen["actions"]["voltage"]["signal"] = "command/values.0"
    assert Rollouts.load(tmp_path, chosen) == expected


def test_a_robot_that_stands_still_is_not_taken_for_a_bomb(tmp_path):
    from mcap_ros2.writer import Writer

    kind = "sensor_msgs/msg/JointState"
    names = [f"joint{k}" for k in range(7)]
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(kind, store().generate_msgdef(kind, ros_version=2)[0])
        for index in range(2_000):
            stamp = {"sec": 1, "nanosec": 400_000 * index}
            message = {
                "header": {"stamp": stamp, "frame_id": ""}, "name": names, "position": [0.5] * 7,
                "velocity": [0.0] * 7, "effort": [0.0] * 7,
            }  # fmt: skip
            writer.write_message("/joints", schema, message, log_time=10**9 + 400_000 * index)
        writer.finish()
    size = (tmp_path / "log.mcap").stat().st_size
    # Numbers that such a log charges, compared with those that its size would allow if it were
    # large enough for the free ones not to matter.
    assert 2_000 * 30 < 4 * size
    assert len(read_log(tmp_path / "log.mcap").signals) == 21


def test_tables_of_a_folder_begin_anew_together(tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    twice = [*np.arange(COUNT) * 0.01] * 2
    both = {"t": twice, "angle": np.arange(2 * COUNT)}
    # Only one of the tables counts its runs.
    runs = np.repeat([0, 1], COUNT)
    pd.DataFrame(both | {"run": runs, "episode": runs}).to_csv(folder / "arm.csv", index=False)
    pd.DataFrame(both).to_csv(folder / "hand.csv", index=False)
    log = read_log(folder).by_name
    assert np.array_equal(log["arm/angle"].time, log["hand/angle"].time)
    channels = {name: {"signal": f"{name}/angle"} for name in ("arm", "hand")}
    rollouts = Rollouts.load(folder, {"log": {"episodes": "arm/run"}, "channels": channels})
    assert len(rollouts) == 2
    assert all(bool((part.readings[0][:, 0] == part.readings[0][:, 1]).all()) for part in rollouts)
