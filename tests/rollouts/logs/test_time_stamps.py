"""Unit and rate of time stamps, as a log is read and as it is described."""

import numpy as np
import pandas as pd
import pytest

from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.logs.formats.parquet_logs import read_frame_log
from npdr_ppl.rollouts.logs.formats.time_stamps import guessed_unit
from npdr_ppl.rollouts.logs.inspection import described
from npdr_ppl.rollouts.logs.log_settings import LogSettings, time_unit_of


def mapping_of(name, **settings):
    return {"log": settings, "channels": {name: {"signal": name}}}


@pytest.mark.parametrize(
    ("step", "count", "unit"),
    [(1.0, 300, "s"), (1.0, 3000, "ms"), (1.05, 60, "s"), (2.0, 60, "ms"), (0.02, 60, "s")],
)
def test_whole_numbers_are_milliseconds_only_if_the_log_then_lasts_a_second(step, count, unit):
    assert guessed_unit("t", step * np.arange(count)) == unit


@pytest.mark.parametrize("kind", ["date", "zoned", "duration", "index", "parquet", "durations"])
@pytest.mark.parametrize("settings", [{}, {"time_unit": "ms"}])
def test_dates_and_durations_have_their_unit_whatever_their_name(tmp_path, kind, settings):
    stamps = pd.to_timedelta(20 * np.arange(50), unit="ms")
    if kind not in ("duration", "durations"):
        stamps = pd.Timestamp("2024-05-01") + stamps
    if kind == "zoned":
        stamps = stamps.tz_localize("Europe/Berlin")
    frame = pd.DataFrame({"time_ms": stamps, "a": np.arange(50.0)})
    chosen = mapping_of("a", **settings)
    if kind in ("parquet", "durations"):
        frame.to_parquet(tmp_path / "x.parquet")
        rollouts = Rollouts.load(tmp_path / "x.parquet", chosen)
    else:
        rollouts = Rollouts.from_dataframe(
            frame.set_index("time_ms") if kind == "index" else frame, chosen
        )
    assert rollouts.time_step == pytest.approx(0.02, rel=1e-6)


def test_a_log_is_described_with_the_time_step_of_its_rollouts():
    """Steps of 10 and 12 ms in turn, two of three of them 10 ms, as on a UR10e."""
    time = np.cumsum(np.tile([0.01, 0.01, 0.012], 300))
    time[500] = 1e6
    frame = pd.DataFrame({"time": time, "a": np.sin(time)})
    (timing,) = described(read_frame_log(frame, LogSettings())).timings
    rollouts = Rollouts.from_dataframe(frame, mapping_of("a"))
    assert timing.step == pytest.approx(rollouts.time_step, rel=1e-6)
    assert timing.step == pytest.approx(0.032 / 3, rel=1e-3)


@pytest.mark.parametrize("time", [[2.0, 1.0], [1.0], [1.0, 1.0], [0.0, 1e308, -1e308, 5.0]])
def test_a_log_of_few_or_impossible_stamps_is_described(time):
    frame = pd.DataFrame({"time": time, "a": np.arange(float(len(time)))})
    (timing,) = described(read_frame_log(frame, LogSettings())).timings
    assert timing.gaps == 0


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("s", "s"), ("seconds", "s"), ("Sec", "s"), ("ms", "ms"), ("msec", "ms"),
        ("milliseconds", "ms"), ("µs", "us"), ("usecs", "us"), ("nanosecond", "ns"),
        ("m", None), ("rad/s", None), ("", None),
    ],
)  # fmt: skip
def test_units_of_time_are_known_in_words(text, unit):
    assert time_unit_of(text) == unit
