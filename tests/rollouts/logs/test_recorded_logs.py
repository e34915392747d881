"""Logs of real robots, as they were written, equal the tables that were made of them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import Mapping, read_log
from npdr_ppl.rollouts.logs.inspection import described
from npdr_ppl.rollouts.logs.load_logs import recording_of_logs
from npdr_ppl.rollouts.notes import faults_among

DATA = Path(__file__).parents[4] / "shared/data"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")

JOINTS = {
    "shoulder_pan": "Rotation", "shoulder_lift": "Pitch", "elbow_flex": "Elbow",
    "wrist_flex": "Wrist_Pitch", "wrist_roll": "Wrist_Roll", "gripper": "Jaw",
}  # fmt: skip

FIELDS = {
    "position": "state_motor/positions",
    "velocity": "state_motor/velocities",
    "load": "state_motor/torques",
    "command": "control/positions",
}


@pytest.mark.parametrize("motion", ["slow_precision", "random_waypoints"])
def test_so_101(motion):
    log = read_log(DATA / "so101" / "raw" / motion)
    table = pd.read_parquet(DATA / "so101" / f"{motion}.parquet")
    for joint, own in JOINTS.items():
        for field, prefix in FIELDS.items():
            signal, column = log.by_name[f"{prefix}/{own}"], table[f"{joint}_{field}"].to_numpy()
            known = np.isfinite(column)
            # The table keeps seven digits.
            np.testing.assert_allclose(signal.values[: len(column)][known], column[known], 1e-6)
            time = signal.time - log.by_name["state_motor/positions/Rotation"].time[0]
            np.testing.assert_allclose(time[: len(column)], table["time"], atol=1e-7)


def test_so_101_becomes_rollouts():
    mapping = {
        "channels": {
            f"{joint}_position": {"signal": f"state_motor/positions/{own}", "unit": "rad"}
            for joint, own in JOINTS.items()
        },
        "actions": {
            f"{joint}_command": {"signal": f"control/positions/{own}", "unit": "rad"}
            for joint, own in JOINTS.items()
        },
    }
    rollouts = Rollouts.load(DATA / "so101" / "raw" / "slow_precision", mapping)
    table = pd.read_parquet(DATA / "so101" / "slow_precision.parquet")
    wanted = table[list(rollouts.channel_names)].to_numpy()[: rollouts.lengths[0] + 1]
    # A step later or earlier changes a position by up to 0.3 rad/s · 20 ms.
    assert np.abs(rollouts.readings[0] - wanted).max() < 0.01
    assert rollouts.time_step == pytest.approx(0.02006, rel=1e-3)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_so_101_in_one_file(tmp_path, suffix):
    """The example of docs/logs.md; both logs have clocks of their own."""
    mapping = {
        "channels": {"position": {"signal": "state_motor/positions/Rotation"}},
        "actions": {"command": {"signal": "control/positions/Rotation"}},
    }
    motions = [DATA / "so101/raw" / name for name in ("slow_precision", "random_waypoints")]
    rollouts = Rollouts.of(recording_of_logs(motions, mapping))
    path = tmp_path / f"so101.{suffix}"
    getattr(rollouts, f"to_{suffix}")(path)
    again = Rollouts.load(path)
    assert again == rollouts
    assert not faults_among(rollouts.notes) and not faults_among(again.notes)


LOGS = {
    "furuta_odrive/logs/oscillations.csv": "/joint_states/joint1/position",
    "furuta_odrive/logs/hardware_pure_joint1_oscillations.csv": "/joint_states/joint1/position",
    "furuta_odrive/logs/hardware_sin_response_2V_1s.csv": "/joint_states/joint1/position",
    "dfki_pendulum/logs/identification.csv": "position",
    "dfki_pendulum/logs/swing_up_ddp.csv": "position",
    "ur10e/logs/ur-20_01_22-joint_2.csv": "column_2",
    "ur10e/logs/ur-20_01_22-joint_4.csv": "column_4",
    "so101/raw/random_waypoints": "state_motor/positions/Rotation",
}


@pytest.mark.parametrize("name", LOGS)
def test_a_position_of_every_log_is_kept_by_every_table(tmp_path, name):
    mapping = {"channels": {"position": {"signal": LOGS[name]}}}
    log = read_log(DATA / name)
    rollouts = Rollouts.of(Mapping.of(mapping).apply(log))
    for suffix in ("csv", "parquet"):
        path = tmp_path / f"position.{suffix}"
        getattr(rollouts, f"to_{suffix}")(path)
        assert Rollouts.load(path) == rollouts
    used = sum(len(part) for part in rollouts.measurements(0))
    assert used > 0.98 * len(log.by_name[LOGS[name]].values)
    assert _step(log, LOGS[name]) == pytest.approx(rollouts.time_step, rel=1e-6)


def _step(log, name):
    return next(
        timing.step
        for timing in described(log).timings
        if name in [signal.name for signal in timing.signals]
    )


@pytest.mark.parametrize("name", ["hardware_sin_response_1V_1s", "oscillations"])
def test_furuta_of_ros(name):
    log = read_log(DATA / "furuta_odrive" / "logs" / f"{name}.csv")
    table = pd.read_parquet(DATA / "furuta_odrive" / f"{name}.parquet")
    for joint, own in (("arm", "joint0"), ("pole", "joint1")):
        signal = log.by_name[f"/joint_states/{own}/position"]
        # The tables hold numbers of four bytes.
        expected = table[f"{joint}_position"].to_numpy()
        np.testing.assert_array_equal(signal.values.astype(expected.dtype), expected)
        # A stamp since 1970 has a resolution of 0.24 µs as float64.
        time = signal.time - signal.time[0]
        np.testing.assert_allclose(time, table["time"], atol=1e-6)


def test_the_gap_of_a_recording_is_found():
    found = described(read_log(DATA / "furuta_odrive/logs/hardware_pure_joint1_oscillations.csv"))
    (timing,) = found.timings
    assert timing.largest == pytest.approx(0.0428, abs=1e-4)
    assert timing.step == pytest.approx(0.002, rel=1e-2)
    assert timing.gaps >= 1
