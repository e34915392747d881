"""Values in a notebook: tables that escape what they show, and axes that come back."""

import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.drawing.html import facts, table
from npdr_ppl.errors import ShapeError
from npdr_ppl.rollouts import Rollouts


@pytest.fixture(autouse=True)
def _closes_figures(monkeypatch):
    import matplotlib
    import matplotlib.pyplot as plt

    monkeypatch.setitem(matplotlib.rcParams, "backend", "agg")
    yield
    plt.close("all")


@pytest.fixture
def rollouts():
    time = torch.arange(11, dtype=torch.float64)[:, None]
    return Rollouts.from_arrays(
        readings=[(time * 0.1).numpy(), (time[:6] * 0.2).numpy()],
        actions=[time[:-1].numpy(), time[:5].numpy()],
        channel_names=("angle<b>",),
        action_names=("torque",),
        channel_units=("rad",),
        time_step=0.02,
    )


@pytest.fixture(scope="module")
def comparison():
    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
        npdr.simulate("x", lambda theta: theta, {"theta": theta}, noise=0.5)

    return npdr.compare(
        model, torch.tensor([0.8, -0.4]), torch.tensor([0.7, -0.5]), rounds=1,
        num_simulations=200, backends=["abc", "again = abc(accept=0.2)"], progress=False,
    )  # fmt: skip


def test_rollouts_show_ranges_and_units(rollouts):
    html = rollouts._repr_html_()
    assert "angle&lt;b&gt;" in html and "<b>" not in html
    assert "5 to 10" in html
    assert "rad" in html
    axes = rollouts.plot()
    assert len(axes) == 2
    assert len(axes[0].lines) == 2
    assert axes[0].get_ylabel() == "angle<b>\n[rad]"
    with pytest.raises(ShapeError, match="2 panels"):
        rollouts.plot(axes[0])


def test_a_posterior_shows_its_parameters(comparison):
    posterior = comparison.posteriors["abc"]
    html = posterior._repr_html_()
    assert html == posterior._repr_html_(), "the same draws each time"
    assert "theta[0]" in html and "theta[1]" in html
    axes = posterior.plot(num_samples=100)
    assert [axis.get_xlabel() for axis in axes] == ["theta[0]", "theta[1]"]
    assert posterior.plot(axes, num_samples=100) is not None
    assert comparison.ensemble._repr_html_()


def test_a_comparison_shows_its_ranking(comparison):
    html = comparison._repr_html_()
    assert html.index(comparison.ranking[0]) < html.index(comparison.ranking[1])
    scores, coverage = comparison.plot()
    assert [t.get_text() for t in scores.get_yticklabels()] == comparison.ranking
    assert len(coverage.lines) == 3


def test_tables_escape():
    assert "<script>" not in facts("<script>", {"<script>": "<script>"})
    assert "<script>" not in table(["<script>"], [["<script>", "<script>"]])
