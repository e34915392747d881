"""Small valid logs of every format, for `fuzz_files.py` to damage."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

COUNT = 30
NS = [1_700_000_000 * 10**9 + 10_000_000 * k for k in range(COUNT)]

JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""

MAPPING = """[log]
time = "t"
time_unit = "us"
header = true
episodes = "lap"
time_step = 0.01
[channels.angle]
signal = "/arm/position"
unit = "deg"
sign = -1
scale = 2.0
offset = 0.1
[actions.voltage]
signal = "u"
"""


def write_logs(folder: Path) -> dict[str, list[Path]]:
    """Writes valid logs; returns their paths by format."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    frame = pd.DataFrame({"t": 0.01 * np.arange(COUNT), "angle": rng.normal(size=COUNT)})
    frame["vector"] = [json.dumps(row) for row in rng.normal(size=(COUNT, 2)).tolist()]
    frame["note"] = "text"
    frame.to_csv(folder / "x.csv", index=False)
    frame.to_csv(folder / "y.csv", index=False, sep=";", header=False)
    lists = frame.assign(vector=[json.loads(cell) for cell in frame["vector"]])
    lists.to_parquet(folder / "x.parquet")
    (folder / "x.toml").write_text(MAPPING)
    _write_trees(folder, frame)
    _write_mcap(folder / "x.mcap")
    _write_json(folder / "y.mcap")
    _write_bag(folder / "bag")
    _write_lerobot(folder / "set", rng)
    motion = folder / "motion"
    motion.mkdir()
    frame.to_csv(motion / "state.csv", index=False)
    frame[["t", "angle"]].to_csv(motion / "command.csv", index=False)
    (motion / "joints.txt").write_text("arm\npole\n")
    return {
        "log_csv": [folder / "x.csv", folder / "y.csv"],
        "log_parquet": [folder / "x.parquet"],
        "h5": [folder / "x.h5"],
        "mat": [folder / "x.mat", folder / "y.mat"],
        "mcap": [folder / "x.mcap", folder / "y.mcap"],
        "db3": list((folder / "bag").glob("*.db3")),
        "bag": [folder / "bag"],
        "lerobot": [folder / "set"],
        "folder": [motion],
        "toml": [folder / "x.toml"],
    }


def _write_trees(folder: Path, frame: pd.DataFrame) -> None:
    import h5py
    from scipy.io import savemat

    with h5py.File(folder / "x.h5", "w") as file:
        file["arm/time"] = frame["t"]
        file.create_dataset("arm/state", data=frame[["angle", "angle"]], compression="gzip")
        file["arm/state"].attrs["units"] = "rad"
    content = {
        "t": frame["t"].to_numpy(),
        "arm": {"angle": frame["angle"].to_numpy(), "word": "text"},
        "cells": np.array([1, "a"], dtype=object),
        "count": np.arange(COUNT, dtype=np.int16),
    }
    savemat(folder / "x.mat", content)
    savemat(folder / "y.mat", content, do_compression=True)


def _message(index: int) -> dict[str, object]:
    stamp = {"sec": NS[index] // 10**9, "nanosec": NS[index] % 10**9}
    return {
        "header": {"stamp": stamp, "frame_id": "base"},
        "name": ["arm", "pole"],
        "position": [0.1 * index, 0.2],
        "velocity": [1.0, 0.0],
        "effort": [],
    }


def _write_mcap(path: Path) -> None:
    from mcap.writer import CompressionType
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for index, ns in enumerate(NS):
            writer.write_message("/joints", schema, _message(index), log_time=ns)
        writer.finish()


def _write_json(path: Path) -> None:
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("/joints", "json", 0)
        for index, ns in enumerate(NS):
            writer.add_message(channel, ns, json.dumps(_message(index)).encode(), ns)
        writer.finish()


def _write_bag(folder: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    kind = "std_msgs/msg/Float64MultiArray"
    make, layout = types.types[kind], types.types["std_msgs/msg/MultiArrayLayout"]
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/voltage", kind, typestore=types)
        for index, ns in enumerate(NS):
            message = make(layout=layout(dim=[], data_offset=0), data=np.array([0.1 * index]))
            writer.write(connection, ns, bytes(types.serialize_cdr(message, kind)))


def _write_lerobot(folder: Path, rng: np.random.Generator) -> None:
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    frame = pd.DataFrame(
        {
            "observation.state": list(rng.normal(size=(COUNT, 2))),
            "action": list(rng.normal(size=(COUNT, 1))),
            "timestamp": np.tile(0.01 * np.arange(COUNT // 2), 2),
            "episode_index": np.repeat([0, 1], COUNT // 2),
        }
    )
    frame.to_parquet(folder / "data" / "chunk-000" / "file-000.parquet")
    features = {
        "observation.state": {"dtype": "float64", "shape": [2], "names": ["arm", "pole"]},
        "action": {"dtype": "float64", "shape": [1], "names": {"motors": ["arm"]}},
    }
    info = {"codebase_version": "v3.0", "fps": 100, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
