"""Table 1's machinery on strikes of our own, and the rig's repeatability on the recordings."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from npdr_ppl import metrics
from npdr_ppl.display.plots.mini_golf_figure import measured_shifts, write_mini_golf_figures
from npdr_ppl.errors import DataError
from npdr_ppl.models.mini_golf import MiniGolf, mini_golf
from npdr_ppl.models.mini_golf.course import OBSTACLES
from npdr_ppl.reproduction import mini_golf_fit
from npdr_ppl.reproduction.mini_golf_clock import clocks_aligned
from npdr_ppl.reproduction.mini_golf_fit import score_strikes
from npdr_ppl.reproduction.mini_golf_posterior import obstacle_angles
from npdr_ppl.reproduction.mini_golf_table import (
    PAPER,
    REPEATABILITY,
    repeatability,
    reproduce_mini_golf,
)
from npdr_ppl.rollouts import Rollouts

RECORDING = Path(__file__).parents[2].parent / "shared/data/mini_golf/strike_100hz_8s.csv"
needs_recording = pytest.mark.skipif(
    not RECORDING.exists(), reason=f"the recordings {RECORDING} are absent"
)

START = (18.996, -87.227, 74.150, -75.577, 56.207, -175.163, -41.544)
END = (8.629, -93.443, 72.302, -82.318, 52.147, -183.896, -51.561)
QUICK = "snpe-c(embedding='linear[ball_x,ball_y]~8', members=1, epochs=3, hidden=(16,))"


@pytest.fixture(scope="module")
def strikes():
    """Two strikes of 0.8 s, made by the simulator with another restitution each."""
    share = np.minimum(np.arange(80) / 50, 1.0)[:, None]
    angles = np.deg2rad(START) + share * np.deg2rad(np.subtract(END, START))
    ball = np.array((0.304, 1.298))
    names = [channel.name for channel in MiniGolf.sensors]
    resting = np.concatenate([np.tile(ball, (81, 1)), np.vstack([angles, angles[-1:]])], axis=1)

    def rollouts(readings):
        return Rollouts.from_arrays(
            readings=readings,
            actions=[angles] * len(readings),
            channel_names=names,
            action_names=[action.name for action in MiniGolf.actions],
            time_step=0.01,
        )

    inputs = rollouts([resting]).inputs(initial_state="recorded")
    struck = MiniGolf().simulate({"ball_restitution": torch.tensor([0.5, 0.7])}, inputs)
    return rollouts([np.vstack([resting[:1], one[0].numpy()]) for one in struck])


@pytest.mark.slow
def test_clocks_of_ball_and_arm_are_aligned(strikes):
    straight = strikes[[0]]  # nominal restitution, so that the simulation's clock is its own
    columns = [strikes.channel_names.index(name) for name in ("ball_x", "ball_y")]
    original = straight.readings[0]

    def shifted(steps):
        readings = np.array(original)
        rows = np.clip(np.arange(len(readings)) - steps, 0, len(readings) - 1)
        readings[:, columns] = original[rows][:, columns]
        return replace(straight, readings=(readings,))

    aligned, delays = clocks_aligned(straight)
    assert delays == [0] and aligned == straight
    for steps in (6, -4):
        aligned, delays = clocks_aligned(shifted(steps))
        assert delays == [-steps]
        inner = slice(10, -10)
        np.testing.assert_array_equal(aligned.readings[0][inner], original[inner])
    resting = np.array(original)
    resting[:, columns] = resting[0, columns]
    with pytest.raises(DataError, match="never struck"):
        clocks_aligned(replace(straight, readings=(resting,)))


@pytest.mark.slow
def test_the_table_has_every_row_and_what_figure_4_shows(strikes, tmp_path, monkeypatch):
    monkeypatch.setattr(mini_golf_fit, "NUM_DRAWS", 200)  # of a posterior that knows little
    posteriors, result = reproduce_mini_golf(
        strikes, tmp_path, backends=[f"snpe-c = {QUICK}"], rounds=1, num_simulations=40,
        progress=False,
    )  # fmt: skip
    assert result["rows"] == json.loads((tmp_path / "mini-golf.json").read_text())["rows"]
    row = result["rows"]["snpe-c"]
    for metric in ("rmse", "dtw", "dtw_open"):
        for name in (metric, f"{metric}_left_out"):
            assert math.isfinite(row[name]["mean"]) and row[name]["std"] >= 0.0
    assert set(result["rows"]) == {"nominal", REPEATABILITY, "snpe-c"}
    details = result["details"]["snpe-c"]
    assert len(details["figure4"]) == len(details["most_likely"]) == 2
    assert 0.0 < details["figure4"][0]["mass_spread"] < 2.0
    assert set(details["two_restitutions"]["angles"]) == {"left", "right"}
    assert result["engine"]["substeps"] == 4
    figures = write_mini_golf_figures({"snpe-c": posteriors["snpe-c"][0]}, tmp_path)
    assert [figure.name for figure in figures] == ["pairs_snpe-c.png"]


def test_the_true_parameters_score_nothing(strikes):
    truth = {"ball_restitution": torch.tensor(0.5)}
    rest = {p.name: torch.tensor(p.nominal) for p in MiniGolf.parameters}
    names = ("ball_radius", "ball_mass", "ball_rolling_friction")
    sides = [f"{s}_{what}" for s in ("left", "right") for what in ("shift_x", "shift_y", "turn")]
    parameters = {name: rest[name] for name in (*names, *sides)} | truth
    scores = score_strikes(mini_golf, strikes[[0]], parameters)
    assert all(float(score[0]) < 1e-6 for score in scores.values())


def test_half_a_turn_makes_no_other_obstacle():
    parameters = {f"{side}_turn": torch.tensor(math.pi) for side in ("left", "right")}
    found = obstacle_angles(parameters)
    for side, box in zip(("left", "right"), OBSTACLES, strict=True):
        assert found[side]["angle"] == pytest.approx(math.degrees(box.angle), abs=1e-3)
    assert found["left"]["error"] == pytest.approx(2.7, abs=1e-3)
    turned = measured_shifts()
    there = obstacle_angles({k: torch.tensor(v) for k, v in turned.items()})
    assert all(abs(side["error"]) < 1e-4 for side in there.values())
    # Of several, the mean of axes: 1 and 3 degrees, the latter turned round.
    turns = torch.deg2rad(torch.tensor([1.0, 183.0]))
    two = obstacle_angles({f"{side}_turn": turns for side in ("left", "right")})
    assert two["left"]["error"] == pytest.approx(4.7, abs=1e-3)


def test_one_strike_is_not_enough(strikes, tmp_path):
    with pytest.raises(DataError, match="two strikes"):
        reproduce_mini_golf(strikes[[0]], tmp_path)


@needs_recording
def test_repeatability_of_the_rig_is_at_the_papers_figure():
    found = repeatability(Rollouts.load(RECORDING))
    assert float(found["rmse"].mean()) == pytest.approx(7.7e-3, abs=0.05e-3)
    assert float(found["dtw_open"].mean()) == pytest.approx(34.3, abs=0.3)
    assert abs(float(found["rmse"].mean()) - PAPER["snpe-c"]["rmse"]["mean"]) < 0.65e-3


@needs_recording
def test_a_ball_that_never_moves_is_far_off():
    rollouts = Rollouts.load(RECORDING)
    series = rollouts.series()
    still = [torch.cat([s[:1, :2].expand(len(s), 2), s[:, 2:]], dim=-1) for s in series]
    assert float(metrics.rmse(still, series).mean()) == pytest.approx(8.0e-2, abs=0.05e-2)
    opened = metrics.dtw(still, series, open_end="measured").mean()
    assert float(opened) == pytest.approx(258.5, abs=1.0)
