"""Figures of a discovery: their content is right, and they work for every result."""

import matplotlib
import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.display.plots.discovery_figures import write_discovery_figures
from npdr_ppl.display.plots.discovery_panels import plot_gap, plot_ranking, plot_separation
from npdr_ppl.display.plots.latent_force_figure import AFTER, BEFORE, plot_latent_force
from npdr_ppl.display.plots.residual_map_figure import plot_residual_map
from npdr_ppl.errors import ShapeError
from npdr_ppl.models.effects.forces import Bias
from npdr_ppl.models.effects.friction import CoulombFriction
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.discovery_recording import FRICTION, pendulum_recording


@pytest.fixture(scope="module")
def found():
    """Dry friction found in a recording, with a held-out rollout."""
    rollouts = pendulum_recording()
    effects = (CoulombFriction("hinge"), Bias("hinge"))
    return npdr.discover(
        pendulum, rollouts[[0, 1, 2]], holdout=rollouts[[3]],
        search=npdr.DiscoveryOptions(effects=effects, max_effects=1),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def without_display():
    matplotlib.use("agg")
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


@pytest.mark.slow
def test_the_latent_force_is_the_friction_and_is_gone_afterwards(found):
    first, last = found.search.rounds[0], found.search.rounds[-1]
    figure = plot_latent_force(first, last, {"velocity": "rad/s"})
    assert figure is not None
    labels = [axis.get_xlabel() for axis in figure.axes]
    assert labels == ["angle", "velocity [rad/s]", "torque", "time [s]"]
    assert figure.axes[0].get_ylabel() == "missing at\nhinge\n[N m]"
    axis = figure.axes[labels.index("velocity [rad/s]")]
    lines = {line.get_label(): line for line in axis.lines}
    for title, expected in ((BEFORE, FRICTION), (AFTER, 0.0)):
        velocity, force = lines[title].get_data()
        # Refitted parameters hide some of it; the sign and more than half of the size are left.
        for side in (velocity > 1.0, velocity < -1.0):
            height = -float(np.mean(np.sign(velocity[side]) * force[side]))
            assert abs(height - expected) < 0.5 * FRICTION
    figure.draw_without_rendering()


@pytest.mark.slow
def test_the_residual_map_frames_the_worst_windows(found):
    start, final = found.search.rounds[0].hypothesis, found.search.final
    figure = plot_residual_map(start, final, found.where)
    panels = [axis for axis in figure.axes if axis.get_ylabel().startswith("rollout")]
    assert [axis.get_ylabel() for axis in panels] == ["rollout 0", "rollout 1", "rollout 2"]
    assert sum(len(axis.patches) for axis in panels) == len(found.where)
    maps = [axis.collections[0].get_array() for axis in figure.axes[:6]]
    before, after = np.ma.mean(maps[0]), np.ma.mean(maps[1])
    assert after < 0.5 * before and after < 3.0
    figure.draw_without_rendering()


def test_separation_marks_what_cannot_be_told_apart():
    distance = np.array([[20.0, 3.0], [2.0, 130.0]])
    figure = plot_separation(distance, ["hinge.coulomb_friction", "angle,velocity.clock_skew"])
    texts = {text.get_text(): text.get_weight() for text in figure.axes[0].texts}
    assert texts == {"20": "normal", "3.0": "bold", "2.0": "bold", "130": "normal"}
    figure.draw_without_rendering()


def test_the_gap_has_its_noise_floor():
    figure = plot_gap({"rmse": Gap(0.4, 0.1, 0.05), "coverage": Gap(0.5, 0.9, None)})
    rmse, coverage = figure.axes
    assert rmse.get_title() == "RMSE: 86% closed"
    assert [bar.get_height() for bar in rmse.patches] == [0.4, 0.1]
    assert rmse.lines[0].get_ydata()[0] == 0.05
    assert coverage.lines[0].get_ydata()[0] == 0.9
    figure.draw_without_rendering()


@pytest.mark.slow
def test_the_ranking_has_a_panel_for_every_effect(found):
    figure = plot_ranking(found.ranking, found)
    titles = [axis.get_title() for axis in figure.axes if axis.get_visible()]
    assert titles == ["each alone, at the model as it was", "what effect 1 could be"]
    assert len(plot_ranking(found.ranking).axes) == 1


@pytest.mark.slow
def test_a_discovery_shows_itself_in_a_notebook(found):
    axes = found.plot()
    assert [axis.get_title().split(":")[0] for axis in axes] == [
        "what effect 1 could be", "RMSE", "DTW", "CRPS"
    ]  # fmt: skip
    with pytest.raises(ShapeError, match="4 panels"):
        found.plot(axes[:2])
    html = found._repr_html_()
    assert "Missing: dry friction at hinge" in html and "verdict: named" in html
    assert 'class="revised"' in html and "of the gap closed" in html and "N m" in html


@pytest.mark.slow
def test_the_held_out_rollout_is_simulated_better_after_the_revision(found):
    (one,) = found.overlays.rollouts
    held_out = pendulum_recording()[[3]]
    assert found.overlays.is_held_out
    assert np.array_equal(one.measured, held_out.readings[0][:-1])
    for channel in ("angle", "velocity"):
        errors = [one.misfit[name][channel] for name in ("nominal", "fitted", "revised")]
        assert errors[0] > errors[1] > 5 * errors[2]
    # The simulation begins again at the measurement every 2 s, a hundred steps.
    jump = np.abs(one.simulated["fitted"] - one.measured)[:, 0]
    assert jump[99] > 5 * jump[100]
    for shown in found.overlays.maps:
        assert shown.before.max() > 3 * shown.after.max()


@pytest.mark.slow
def test_all_figures_are_drawn_and_small_enough_for_a_report(found, tmp_path):
    paths = write_discovery_figures(found, tmp_path)
    assert {path.stem for path in paths} == {
        "residual_map", "latent_force", "ranking", "separation", "parameters", "effects", "gap"
    }  # fmt: skip
    assert sum(path.stat().st_size for path in paths) < 500_000


@pytest.mark.slow
def test_a_discovery_that_adds_nothing_has_figures_too(tmp_path):
    rollouts = pendulum_recording(num_rollouts=2)
    options = npdr.DiscoveryOptions(effects=(Bias("hinge"),), max_effects=0)
    torch.manual_seed(0)
    found = npdr.discover(pendulum, rollouts, search=options)
    paths = write_discovery_figures(found, tmp_path)
    assert {path.stem for path in paths} == {
        "residual_map", "latent_force", "ranking", "separation", "parameters"
    }  # fmt: skip
    (axis,) = found.plot()
    assert axis.get_title() == "verdict: unknown"
    assert "unknown" in found._repr_html_()
