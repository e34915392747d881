"""Figures are drawn for every shape of posterior, and say what they show."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from matplotlib.figure import Figure

import npdr_ppl as npdr
from npdr_ppl.display.plots import (
    plot_bands,
    plot_bands_by_backend,
    plot_heatmaps,
    plot_marginals,
    plot_overlaid_marginals,
    plot_pair,
    plot_seconds,
    save_figure,
)
from npdr_ppl.display.plots.bands import nominal_line
from npdr_ppl.display.plots.comparison_figures import (
    most_informative,
    write_comparison_figures,
)
from npdr_ppl.display.plots.fit_figures import write_fit_figures
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.rollouts import Rollouts

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
    # A line that is far off does not squeeze the recording.
    figure = plot_bands(
        time, measured, measured[None], channel_names=("x", "y"),
        lines={"nominal": measured + 1e6},
    )  # fmt: skip
    assert figure.axes[0].get_ylim()[1] < 2


def test_nothing_is_drawn_across_a_gap():
    time = np.delete(np.linspace(0, 1, 50), slice(20, 30))
    measured = np.stack([np.sin(time), np.cos(time)], -1)
    figure = plot_bands(time, measured, measured[None], channel_names=("x", "y"))
    (line,) = (line for line in figure.axes[0].lines if line.get_label() == "measured")
    assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [20]
    assert np.isfinite(figure.axes[0].get_ylim()).all()


def test_a_recording_with_a_gap_has_the_times_of_what_is_used():
    rollouts = dataclasses.replace(recorded(), stretches=(((0, 20), (30, 60)),))
    (series,), (time,) = rollouts.series(), rollouts.times_of_series
    assert time.tolist() == pytest.approx([0.02 * k for k in (*range(20), *range(30, 60))])
    found = replay(pendulum, rollouts, {"mass": torch.ones(1), "length": torch.ones(1)}, OPTIONS)
    assert len(time) == len(series) == found.series()[0].shape[-2]


def recorded(num_steps=60):
    """A pendulum's swing in columns without units, as a CSV file has them."""
    time = 0.02 * np.arange(num_steps + 1)
    readings = np.stack([np.sin(3 * time), 3 * np.cos(3 * time)], -1)
    return Rollouts.from_arrays(
        readings=[readings], actions=[np.zeros((num_steps, 1))], time_step=0.02,
        channel_names=("angle", "velocity"), action_names=("torque",),
    )  # fmt: skip


OPTIONS = DataOptions(None, 20, "recorded", "float64")


def predicted(rollouts):
    """Semi-implicit Euler of the zoo's pendulum: 1 kg, 1 m, from each segment's first reading."""
    readings, result = rollouts.readings[0], []
    for step in range(60):
        if step % 20 == 0:
            angle, velocity = readings[step]
        result.append([angle, velocity])
        velocity = velocity - 0.02 * 3.0 * 9.81 / 2.0 * np.sin(angle)
        angle = angle + 0.02 * velocity
    return np.array(result)


def test_the_nominal_line_is_the_simulators_own_prediction():
    rollouts = recorded()
    (line,) = nominal_line(pendulum, rollouts, OPTIONS).values()
    np.testing.assert_allclose(line, predicted(rollouts), atol=1e-6)


def test_a_model_without_nominal_parameters_has_no_such_line():
    def other(inputs):
        mass = pyro.sample("weight", dist.Uniform(0.3, 1.7))
        return npdr.simulate("trajectory", Pendulum(), {"mass": mass}, inputs)

    assert nominal_line(other, recorded(), OPTIONS) == {}


def test_units_that_a_recording_lacks_are_the_simulators():
    nominal = {"mass": torch.ones(1), "length": torch.ones(1)}
    assert replay(pendulum, recorded(), nominal, OPTIONS).units == ("rad", "rad/s")
    named = dataclasses.replace(recorded(), channel_units=("turns", ""))
    assert replay(pendulum, named, nominal, OPTIONS).units == ("turns", "rad/s")


def test_rounds_share_their_axes():
    figure = plot_heatmaps(
        {"": {"round 1": PRIOR, "round 2": POSTERIORS["broad"]}}, "mass", "length",
        ranges=((0, 1), (1, 2)), truth={"mass": 0.5, "length": 1.5}, units=("kg", "m"),
    )  # fmt: skip
    assert [axis.get_title() for axis in figure.axes] == ["round 1", "round 2"]
    assert {axis.get_xlim() for axis in figure.axes} == {(0.0, 1.0)}


def test_posteriors_lie_over_each_other(tmp_path):
    figure = plot_overlaid_marginals(
        POSTERIORS, PRIOR, marks={"truth": {"mass": 0.5}}, units={"mass": "kg"}
    )
    assert legend(figure) == {"prior", "truth", *POSTERIORS}
    assert [axis.get_xlabel() for axis in figure.axes] == ["mass [kg]", "length"]
    assert save_figure(figure, tmp_path / "figure.png").stat().st_size > 5_000


def test_heatmaps_have_a_row_for_each_method():
    figure = plot_heatmaps(
        {"snpe-c": {"round 1": PRIOR, "NUTS": PRIOR}, "snpe-a": {"round 1": PRIOR}},
        "mass", "length", ranges=((0, 1), (1, 2)), units=("kg", "m"), smoothing=1.0,
    )  # fmt: skip
    shown = [axis for axis in figure.axes if axis.get_visible()]
    assert [axis.get_title() for axis in shown] == ["round 1", "NUTS", "round 1"]
    assert [axis.get_ylabel() for axis in shown] == [
        "snpe-c\nlength [m]", "", "snpe-a\nlength [m]"
    ]  # fmt: skip
    # The lowest panel of every column names the axis, also where another row is longer.
    assert [axis.get_xlabel() for axis in shown] == ["", "mass [kg]", "mass [kg]"]


def test_bands_have_a_column_for_each_backend():
    time = np.linspace(0, 1, 50)
    measured = np.stack([np.sin(time), np.cos(time)], -1)
    draws = measured + 0.1 * rng.standard_normal((20, 50, 2))
    draws[3, 10] = np.nan
    predictives = {"a": draws, "b": draws + 100.0, "c": np.full_like(draws, np.nan)}
    figure = plot_bands_by_backend(
        time, measured, predictives, channel_names=("x", "y"), units=("m", ""),
        lines={"nominal": measured + 100.0}, resets=np.array([0.0, 0.5]),
    )  # fmt: skip
    assert legend(figure) == {"measured", "nominal", "posterior 90%", "posterior 50%"}
    assert [axis.get_title() for axis in figure.axes] == ["a", "b", "c", "", "", ""]
    assert [axis.get_ylabel() for axis in figure.axes] == ["x\n[m]", "", "", "y", "", ""]
    # Two bands; failed draws are left out, and where all failed there is nothing to draw.
    assert [len(axis.collections) for axis in figure.axes[:3]] == [2, 2, 0]
    # A prediction that is far off does not squeeze the recording.
    assert figure.axes[0].get_ylim()[1] < 2


def test_seconds_have_a_bar_for_each_backend():
    figure = plot_seconds({
        "a": {"simulate": 1.0, "train": 2.0, "sample": 0.5}, "b": {"train": 0.25}
    })  # fmt: skip
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["a", "b"]
    assert [text.get_text().strip() for text in axis.texts] == ["3.5 s", "0.25 s"]
    assert legend(figure) == {"simulate", "train", "sample"}


def test_the_most_contracted_parameters_are_chosen_in_the_models_order():
    prior = {name: rng.normal(0, 1, 500) for name in "abc"}
    spread = {"a": 0.5, "b": 0.9, "c": 0.1}
    posterior = {name: rng.normal(0, spread[name], 500) for name in prior}
    assert most_informative({"q": posterior}, prior) == ("a", "c")


@pytest.fixture
def written(monkeypatch):
    """Keeps figures by the name of the file that they would be written to."""
    figures = {}

    def keep(figure, path, **_):
        figures[Path(path).name] = figure

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


@pytest.fixture(scope="module")
def posterior():
    """Some posterior of the recorded swing."""
    return npdr.infer(
        pendulum, recorded(), backend=backend("abc"), rounds=1, num_simulations=60,
        options=dataclasses.replace(OPTIONS, embedding="all/10"), progress=False,
    )  # fmt: skip


def curve(axis, label):
    """Returns the points of all lines with a legend entry, ``(T, 2)``."""
    return np.concatenate([line.get_xydata() for line in axis.lines if line.get_label() == label])


def check_lines(axes, rollouts):
    """Checks the recording and the nominal simulation in the panels of both channels."""
    time = 0.02 * np.arange(60)
    nominal = predicted(rollouts)
    for axis, line, readings in zip(axes, nominal.T, rollouts.readings[0].T, strict=True):
        np.testing.assert_allclose(curve(axis, "measured"), np.stack([time, readings[:60]], -1))
        np.testing.assert_allclose(curve(axis, "nominal"), np.stack([time, line], -1), atol=1e-6)


def test_a_fit_draws_its_predictions_and_the_nominal_ones_with_units(posterior, written, tmp_path):
    rollouts = recorded()
    write_fit_figures(posterior, pendulum, rollouts, tmp_path)
    assert set(written) == {"marginals.png", "pairs.png", "bands.png"}
    axes = written["bands.png"].axes
    # The recording has no units, but the simulator has.
    assert [axis.get_ylabel() for axis in axes] == ["angle\n[rad]", "velocity\n[rad/s]"]
    assert axes[-1].get_xlabel() == "time [s]"
    lines = {"measured", "nominal", "most likely"}
    assert legend(written["bands.png"]) == {*lines, "posterior 90%", "posterior 50%"}
    check_lines(axes, rollouts)
    # The recorded swing is not that of a nominal pendulum.
    likely, nominal = curve(axes[0], "most likely"), curve(axes[0], "nominal")
    assert np.abs(likely - nominal).max() > 1e-3
    # Every segment starts from a measurement.
    starts = [line.get_xdata()[0] for line in axes[0].lines if line.get_label()[0] == "_"]
    assert starts == pytest.approx([0.0, 0.4, 0.8])
    panels = [axis.get_xlabel() for axis in written["marginals.png"].axes]
    assert panels == ["mass [kg]", "length [m]"]
    assert legend(written["marginals.png"]) == {"prior", "posterior", "most likely"}


def test_a_comparison_draws_the_nominal_predictions_in_every_column_with_units(
    posterior, written, tmp_path
):
    rollouts, labels = recorded(), ["one", "other"]
    found = SimpleNamespace(
        ranking=labels, posteriors=dict.fromkeys(labels, posterior),
        rows=dict.fromkeys(labels, SimpleNamespace(seconds={"train": 1.0})),
    )  # fmt: skip
    write_comparison_figures(found, pendulum, rollouts, tmp_path)
    assert set(written) == {"marginals.png", "pairs.png", "bands.png", "seconds.png"}
    axes = np.array(written["bands.png"].axes).reshape(2, 2)
    assert [axis.get_title() for axis in axes[0]] == labels
    assert [axis.get_ylabel() for axis in axes[:, 0]] == ["angle\n[rad]", "velocity\n[rad/s]"]
    assert [axis.get_xlabel() for axis in axes[1]] == ["time [s]"] * 2
    bands = {"posterior 90%", "posterior 50%"}
    assert legend(written["bands.png"]) == {"measured", "nominal", *bands}
    for column in axes.T:
        check_lines(column, rollouts)
    panels = [axis.get_xlabel() for axis in written["marginals.png"].axes]
    assert panels == ["mass [kg]", "length [m]"]
