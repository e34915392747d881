"""Logs of real robots, as they were written, equal the tables that were made of them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs import read_log
from npdr_ppl.rollouts.logs.inspection import described

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
