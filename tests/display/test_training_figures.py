"""Figures of the NPDR loop: they show every iteration, and the pendulum stands where it should."""

import math

import numpy as np
import pytest
from PIL import Image

from npdr_ppl.display.plots.furuta_animation import furuta_points, write_furuta_animation
from npdr_ppl.display.plots.training_figures import (
    last_rollout,
    plot_learning_curve,
    plot_parameters_by_iteration,
    plot_rollouts,
)
from npdr_ppl.errors import DataError
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.rollouts import Rollouts


def record(returns, num_rollouts, *decisions, sim_return=None):
    trained = {} if sim_return is None else {"sim_return": sim_return}
    return trained | {
        "real_returns": returns,
        "real_return": sum(returns) / len(returns),
        "num_rollouts": num_rollouts,
        "decision": decisions[-1],
        "decisions": [{"decision": decision} for decision in decisions],
    }


RECORDS = [
    record([10.0, 20.0], 3, "new rollout", "accept", sim_return=40.0),
    record([30.0, 50.0], 5, "accept", sim_return=60.0),
]


def rollout(num_steps, turn=0.0):
    time = 0.002 * np.arange(num_steps + 1)
    readings = np.stack([turn * time, 3.0 * time, turn + 0 * time, 3.0 + 0 * time], -1)
    return Rollouts.from_arrays(
        readings=readings[None], actions=np.ones((1, num_steps, 1)),
        channel_names=[sensor.name for sensor in Furuta.sensors], action_names=("voltage",),
        time_step=0.002, channel_units=[sensor.unit for sensor in Furuta.sensors],
        action_units=("V",),
    )  # fmt: skip


def lines(axis):
    return {line.get_label(): line for line in axis.lines}


def test_returns_are_those_of_the_policy_that_an_iteration_ran():
    figure = plot_learning_curve(RECORDS, first_sim_return=5.0, success=45.0)
    (axis,) = figure.axes
    drawn = lines(axis)
    assert drawn["on the target, mean"].get_xydata().tolist() == [[1, 15], [2, 40]]
    # What the first iteration trained is what the second one ran.
    simulated = drawn["in simulation, mean over domains"]
    assert simulated.get_xydata().tolist() == [[1, 5], [2, 40], [3, 60]]
    assert "success" in drawn
    labels = [label.get_text() for label in axis.get_xticklabels()]
    assert labels == ["1\nnew rollout\naccept", "2\naccept", "trained\nlast"]


def test_a_run_that_stopped_has_no_policy_left_to_run():
    figure = plot_learning_curve([RECORDS[0], record([70.0], 4, "stop")])
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_xticklabels()][-1] == "2\nstop"
    figure.draw_without_rendering()


def test_the_last_rollout_is_the_policys_own():
    assert last_rollout(RECORDS[:1]) == 1, "the third was asked for by a diagnosis"
    assert last_rollout(RECORDS) == 4


def test_rollouts_have_a_panel_for_each_channel_and_command():
    figure = plot_rollouts({"first": rollout(40), "last": rollout(100)})
    assert [axis.get_ylabel() for axis in figure.axes] == [
        "arm_angle\n[rad]", "pole_angle\n[rad]", "arm_velocity\n[rad/s]",
        "pole_velocity\n[rad/s]", "voltage\n[V]",
    ]  # fmt: skip
    for axis in figure.axes:
        crosses = [line for line in axis.lines if line.get_marker() == "x"]
        assert [line.get_xdata()[0] for line in crosses] == [pytest.approx(0.08)]
    figure.draw_without_rendering()


def test_parameters_are_drawn_within_their_prior():
    prior = {"mass": np.random.default_rng(0).uniform(1.0, 2.0, 2_000)}
    prior["arm.bias.offset"] = prior["mass"]
    values = {"mass": np.array([1.1, 1.9]), "arm.bias.offset": np.array([np.nan, 1.5])}
    spread = {"mass": np.array([0.5, 0.1]), "arm.bias.offset": np.array([np.nan, 0.1])}
    figure = plot_parameters_by_iteration(
        values, spread, prior, nominal={"mass": 1.5}, units={"mass": "kg"}
    )
    assert [axis.get_title() for axis in figure.axes] == ["mass [kg]", "arm\nbias.offset"]
    low, high = figure.axes[0].get_ylim()
    assert 0.9 < low < 1.05 and 1.95 < high < 2.1
    figure.draw_without_rendering()


def test_the_pendulum_stands_where_its_angles_say():
    pivot, tip = furuta_points(
        np.array([0.0, 0.0, math.pi / 2, 0.0]), np.array([0.0, math.pi, math.pi, math.pi / 2]),
        arm_length=2.0, pole_length=3.0,
    )  # fmt: skip
    np.testing.assert_allclose(pivot, [[2, 0, 0], [2, 0, 0], [0, 2, 0], [2, 0, 0]], atol=1e-12)
    # Hanging, upright, upright with the arm turned, and level: along the arm's motion.
    np.testing.assert_allclose(tip, [[2, 0, -3], [2, 0, 3], [0, 2, 3], [2, 3, 0]], atol=1e-12)


def test_animations_run_in_real_time(tmp_path):
    path = write_furuta_animation(rollout(200, turn=5.0), tmp_path / "new/rollout.gif")
    with Image.open(path) as image:
        durations = []
        for frame in range(image.n_frames):
            image.seek(frame)
            durations.append(image.info["duration"])
    # 0.4 s at 20 frames per second, the last of which is shown as well.
    assert durations == [50] * 9
    assert path.stat().st_size < 2e6


def test_only_furuta_pendulums_are_animated(tmp_path):
    other = rollout(10).select(("arm_angle",))
    with pytest.raises(DataError, match="pole_angle"):
        write_furuta_animation(other, tmp_path / "rollout.gif")
