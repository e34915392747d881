"""Figures are drawn for every shape of posterior, and say what they show."""

import numpy as np
import pytest

from npdr_ppl.plots import plot_bands, plot_marginals, plot_pair, plot_rounds, save_figure

rng = np.random.default_rng(0)
PRIOR = {"mass": rng.uniform(0, 1, 500), "length": rng.uniform(1, 2, 500)}
POSTERIORS = {
    "broad": {"mass": rng.uniform(0.2, 0.8, 400), "length": rng.uniform(1.2, 1.8, 400)},
    "at the edge": {
        "mass": 1 - 1e-6 * rng.uniform(0, 1, 400), "length": 1 + 1e-6 * rng.uniform(0, 1, 400)
    },
    "a point": {"mass": np.full(400, 0.5), "length": np.full(400, 1.5)},
}  # fmt: skip


def legend(figure):
    return {text.get_text() for found in figure.legends for text in found.get_texts()}


@pytest.mark.parametrize("kind", POSTERIORS)
def test_marginals_and_pairs(kind, tmp_path):
    marks = {"truth": {"length": 1.5}}
    for plot in (plot_marginals, plot_pair):
        figure = plot(POSTERIORS[kind], PRIOR, marks=marks)
        assert {"prior", "truth"} <= legend(figure)
        assert save_figure(figure, tmp_path / "new folder" / "figure.png").stat().st_size > 5_000


def test_bands_have_every_channel():
    time = np.linspace(0, 1, 50)
    measured = np.stack([np.sin(time), np.cos(time)], -1)
    figure = plot_bands(
        time, measured, measured + 0.1 * rng.standard_normal((20, 50, 2)),
        channel_names=("x", "y"), units=("m", ""), lines={"nominal": measured + 0.1},
        resets=np.array([0.0, 0.5]),
    )  # fmt: skip
    assert [axis.get_ylabel() for axis in figure.axes] == ["x\n[m]", "y"]
    assert {"measured", "nominal", "posterior 90%", "posterior 50%"} == legend(figure)


def test_rounds_share_their_axes():
    figure = plot_rounds(
        {"round 1": PRIOR, "round 2": POSTERIORS["broad"]}, "mass", "length",
        ranges=((0, 1), (1, 2)), truth={"mass": 0.5, "length": 1.5}, units=("kg", "m"),
    )  # fmt: skip
    assert [axis.get_title() for axis in figure.axes] == ["round 1", "round 2"]
    assert {axis.get_xlim() for axis in figure.axes} == {(0.0, 1.0)}
