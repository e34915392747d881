"""Figures of a calibration show every parameter, the band and the verdict."""

import numpy as np

from npdr_ppl.display.plots import plot_coverage, plot_ranks, save_figure
from npdr_ppl.posterior.calibration.calibration_result import Calibration
from npdr_ppl.posterior.calibration.uniformity import simultaneous_band

rng = np.random.default_rng(0)
RANKS = rng.integers(0, 200, (150, 7))
FOUND = Calibration(
    parameters=("mass", "length", "friction", "delay", "gain"),
    ranks=np.column_stack((RANKS[:, :4], 100 + RANKS[:, 4] // 4)),
    density_ranks=RANKS[:, 5],
    distance_ranks=RANKS[:, 6],
    num_draws=199,
    num_failed=0,
    is_refit=False,
    seed=0,
)


def curve(axis, label):
    (line,) = [line for line in axis.get_lines() if line.get_label() == label]
    return line.get_xydata()


def test_ranks_have_a_panel_for_every_parameter():
    figure = plot_ranks(FOUND)
    shown = [axis for axis in figure.axes if axis.get_visible()]
    assert [axis.get_title() for axis in shown] == list(FOUND.parameters)
    band = simultaneous_band(150, 199)
    for axis, name in zip(shown, FOUND.parameters, strict=True):
        t, difference = curve(axis, "ranks").T
        inside = (difference >= band.low - t) & (difference <= band.high - t)
        # Only the parameter whose ranks are not uniform leaves its band.
        assert inside.all() == (name != "gain")
    assert "p < 0.0001" in {text.get_text() for text in shown[-1].texts}


def test_coverage_is_that_of_the_result():
    figure = plot_coverage(FOUND)
    for axis, of in zip(figure.axes, ("highest_density", "tarp"), strict=True):
        t, share = curve(axis, "posterior").T
        expected = [level.expected for level in FOUND.coverage(t, of)]
        assert np.allclose(share, expected)


def test_figures_are_written(tmp_path):
    for draw in (plot_ranks, plot_coverage):
        path = save_figure(draw(FOUND), tmp_path / "figure.png")
        assert path.stat().st_size > 5_000
