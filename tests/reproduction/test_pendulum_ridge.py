"""Figure 2's machinery: every method gets the budget of all, and its own row of panels."""

import sys

import numpy as np
import pytest
import torch

from npdr_ppl.display.plots.pendulum_figure import write_pendulum_figures
from npdr_ppl.errors import DependencyError
from npdr_ppl.inference.registry import backend
from npdr_ppl.posterior.comparison.compared_backends import Candidate, available
from npdr_ppl.reproduction import pendulum_ridge
from npdr_ppl.reproduction.pendulum_ridge import METHODS, Ridge, exact_samples, record, valley


@pytest.fixture
def short(monkeypatch):
    """Two rounds of thirty simulations on a coarse grid: the machinery, not the figure."""
    monkeypatch.setattr(pendulum_ridge, "ROUNDS", 2)
    monkeypatch.setattr(pendulum_ridge, "NUM_SIMULATIONS", 30)
    monkeypatch.setattr(pendulum_ridge, "GRID", 60)


def test_every_method_has_a_row_of_its_rounds_beside_nuts(short, tmp_path):
    rollouts = record(50)
    inputs = rollouts.inputs(initial_state="recorded")
    observed = rollouts.observation(inputs)
    quick = {"transforms": 1, "hidden": (16,), "epochs": 2, "members": 1}
    posteriors = {
        label: pendulum_ridge.infer_mass_and_length(
            Candidate(backend("snpe-c", flow=flow, **quick)), rollouts, 0, False
        )
        for label, flow in (("splines", "nsf"), ("affine", "maf"))
    }
    assert {len(p.states) for p in posteriors.values()} == {2}
    assert {r.num_simulations for p in posteriors.values() for r in p.provenance.rounds} == {30}
    exact = exact_samples(inputs, observed, seed=0)
    ridge = Ridge(posteriors, exact, valley(inputs, observed))
    # Without a round it is the last one; the first is another posterior.
    np.testing.assert_array_equal(ridge.samples("affine"), ridge.samples("affine", 1))
    assert not np.array_equal(ridge.samples("affine"), ridge.samples("affine", 0))
    (figure,) = write_pendulum_figures({"1 s": ridge}, tmp_path)
    assert figure.name == "pendulum_1_s.png"
    assert figure.stat().st_size > 10_000


@pytest.mark.slow
def test_the_exact_posterior_lies_on_the_valley(short):
    rollouts = record(50)
    inputs = rollouts.inputs(initial_state="recorded")
    observed = rollouts.observation(inputs)
    found = pendulum_ridge.figures(
        exact_samples(inputs, observed, seed=0),
        exact_samples(inputs, observed, seed=1),
        valley(inputs, observed),
    )
    assert found["on_curve"] > 0.95
    assert abs(found["c2st"] - 0.5) < 0.05
    assert torch.isfinite(torch.tensor(list(found.values()))).all()


QUICK = "quick = snpe-c(transforms=1, hidden=(16,), epochs=2, members=1)"


def test_what_the_score_needs_is_missed_before_anything_is_fitted(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)  # as where it is not installed
    with pytest.raises(DependencyError, match=r"needs scikit-learn.* pip install scikit-learn"):
        pendulum_ridge.reproduce_pendulum(tmp_path / "out", backends=[QUICK], progress=False)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_fits_are_kept_where_the_score_is_interrupted(short, tmp_path, monkeypatch):
    monkeypatch.setattr(pendulum_ridge, "DURATIONS", {"1 s": 50})
    monkeypatch.setattr(pendulum_ridge, "NUM_SAMPLES", 100)

    def exact(inputs, observed, *, start, seed):
        return exact_samples(inputs, observed, seed=seed + 1)

    # NUTS takes half a minute, and is not what this is about.
    monkeypatch.setattr(pendulum_ridge, "nuts_samples", exact)

    def interrupted(*args):
        raise KeyboardInterrupt

    def reproduce():
        return pendulum_ridge.reproduce_pendulum(tmp_path, backends=[QUICK], progress=False)

    with monkeypatch.context() as patch:
        patch.setattr(pendulum_ridge, "figures", interrupted)
        with pytest.raises(KeyboardInterrupt):
            reproduce()
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "quick/1_s").glob("round_*")}
    assert len(kept) >= 2 and not (tmp_path / "pendulum.json").exists()
    ridges, result = reproduce()
    # The rounds are read: none is written again.
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert len(ridges["1 s"].posteriors["quick"].states) == 2
    assert set(result["rows"]) == {"quick, 1 s", "nuts, 1 s", "grid, 1 s"}
    assert (tmp_path / "pendulum.json").exists()


def test_the_papers_methods_run_or_say_why_not():
    found, skipped = available(METHODS)
    assert "snpe-c" in found
    assert set(found) | set(skipped) == set(METHODS)
