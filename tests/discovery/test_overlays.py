"""Series for reports: thinned without losing peaks, and safe where a simulation failed."""

import json

import numpy as np
import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery import DiscoveryOptions
from npdr_ppl.discovery.proof.overlays import MOST_POINTS, Overlay, Overlays, ResidualMap
from npdr_ppl.run_files import plain, read_json, write_json
from npdr_ppl.run_records import OverlayRecord

CHANNELS = ("angle", "velocity")


def overlay(num, simulated):
    measured = np.stack([np.sin(np.arange(num) / 50.0), np.zeros(num)], 1)
    return Overlay(4, 0.002 * np.arange(num), measured, {"fitted": simulated}, {})


def test_a_short_series_is_kept_as_it_is():
    shown = overlay(300, np.ones((300, 2))).to_dict(CHANNELS)
    assert len(shown["time"]) == 300
    assert shown["channels"]["velocity"]["fitted"] == [1.0] * 300


def test_a_long_series_keeps_a_peak_of_one_sample():
    num = 20_011
    simulated = np.zeros((num, 2))
    simulated[12_345, 1] = 7.0
    shown = overlay(num, simulated).to_dict(CHANNELS)
    series = shown["channels"]["velocity"]["fitted"]
    assert max(series) == 7.0
    assert MOST_POINTS / 2 < len(series) <= MOST_POINTS + 2
    lengths = {len(v) for channel in shown["channels"].values() for v in channel.values()}
    assert lengths == {len(shown["time"])}
    assert shown["time"] == sorted(shown["time"])
    assert abs(shown["time"][series.index(7.0)] - 12_345 * 0.002) < 2 * num * 0.002 / MOST_POINTS


def test_errors_are_those_of_the_same_time_however_long_the_series_is():
    num, late = 60_000, 2
    time = 0.001 * np.arange(num)
    measured = np.sin(2 * np.pi * 3.0 * time)[:, None]
    fitted = np.sin(2 * np.pi * 3.0 * (time - 0.001 * late))[:, None]
    one = Overlay(0, time, measured, {"fitted": fitted, "nominal": fitted}, {})
    channel = one.to_dict(("angle",))["channels"]["angle"]
    errors = np.array(channel["fitted_error"])
    assert abs(errors).max() == pytest.approx(abs(fitted - measured).max())
    assert set(channel) == {"measured", "fitted", "nominal", "fitted_error"}


def test_small_errors_of_large_values_are_kept():
    measured = np.linspace(3.0, 3.1, 50)[:, None]
    one = Overlay(0, np.arange(50.0), measured, {"fitted": measured + 2e-5}, {})
    channel = one.to_dict(("angle",))["channels"]["angle"]
    assert channel["fitted_error"] == pytest.approx([2e-5] * 50)
    shown = np.array(channel["fitted"]) - np.array(channel["measured"])
    assert shown == pytest.approx(np.full(50, 2e-5), rel=1e-2)


def test_where_a_simulation_failed_is_nothing():
    for num in (300, 20_000):
        simulated = np.ones((num, 2))
        simulated[num // 2 :] = np.nan
        simulated[0] = np.inf
        shown = overlay(num, simulated).to_dict(CHANNELS)
        series = shown["channels"]["angle"]["fitted"]
        assert series[-1] is None and 1.0 in series
        json.dumps(plain(shown), allow_nan=False)


@pytest.mark.parametrize(
    ("num_channels", "num_rollouts", "points"),
    [(2, 3, 500), (14, 3, 400), (60, 2, 150), (400, 1, 40)],
)
def test_the_file_of_any_robot_can_be_read_back(tmp_path, num_channels, num_rollouts, points):
    channels = tuple(f"joint_{k}" for k in range(num_channels))
    values = np.ones((5_000, num_channels))
    simulated = dict.fromkeys(("nominal", "fitted", "revised"), values)
    one = Overlay(0, 0.002 * np.arange(5_000), values, simulated, {})
    units = dict.fromkeys(channels, "rad")
    found = Overlays(True, channels, units, (one, one, one), ()).to_dict()
    write_json(tmp_path / "overlays.json", found)
    read = read_json(tmp_path / "overlays.json", OverlayRecord)
    assert len(read["rollouts"]) == num_rollouts
    assert len(read["rollouts"][0]["time"]) >= points


def test_a_map_has_a_row_per_channel():
    cells = np.array([[1.0, 2.0], [3.0, np.nan], [5.0, 6.0]])
    shown = ResidualMap(0, 6.0, cells, cells).to_dict()
    assert shown["before"] == [[1.0, 3.0, 5.0], [2.0, None, 6.0]]


@pytest.mark.slow
def test_a_rollout_that_is_left_out_is_not_drawn():
    case = make_case("pendulum", "null", (), seed=1)
    first = case.fit[[1]]
    recorded = first.concatenate(first, case.fit[[0]])  # the copy is left out
    found = npdr.discover(
        case.model, recorded, search=DiscoveryOptions(max_effects=0), progress=False
    )
    assert [
        shown.rollout for shown in sorted(found.overlays.rollouts, key=lambda o: o.rollout)
    ] == [
        0,
        2,
    ]
    for shown, rollout in ((o, recorded[[o.rollout]]) for o in found.overlays.rollouts):
        assert shown.measured == pytest.approx(rollout.readings[0][:-1])
