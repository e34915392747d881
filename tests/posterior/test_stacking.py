"""Stacking weights against their own definition; the stacked posterior as a posterior."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from pyro.infer import Predictive

import npdr_ppl as npdr
from npdr_ppl.errors import DataError
from npdr_ppl.inference.base import Density
from npdr_ppl.posterior.comparison.stacking import StackedPosterior, mixture_elpd, stack


def mixture_proportions(log_densities, steps=20_000):
    """The weights that maximise Σ_i log Σ_k w_k p_ik, by expectation maximisation."""
    density = np.exp(log_densities - log_densities.max(0))
    weights = np.full(len(density), 1 / len(density))
    for _ in range(steps):
        weights = (weights[:, None] * density / (weights @ density)).mean(1)
    return weights


@pytest.mark.parametrize("spread", [0.5, 3.0, 300.0])
def test_weights_maximise_the_mixtures_density(spread):
    rng = np.random.default_rng(1)
    # Segments of many readings have densities far below the smallest float.
    pointwise = {name: -2_000 + spread * rng.standard_normal(30) for name in "abc"}
    found = stack(pointwise)
    expected = mixture_proportions(np.stack(list(pointwise.values())))
    best = mixture_elpd(pointwise, dict(zip(pointwise, expected, strict=True))).sum()
    assert math.isclose(sum(found.weights.values()), 1.0)
    assert abs(mixture_elpd(pointwise, found.weights).sum() - best) < 1e-4
    assert min(found.difference.values()) == 0
    worse = max(found.difference, key=lambda name: found.difference[name])
    assert pointwise[worse].sum() == min(values.sum() for values in pointwise.values())


def test_posteriors_that_rule_the_recording_out_get_no_weight():
    good, bad = np.zeros(5), np.array([0.0, -np.inf, 0.0, 0.0, 0.0])
    found = stack({"bad": bad, "good": good})
    assert found.weights == {"bad": 0.0, "good": 1.0}
    assert "bad" not in found.difference
    with pytest.raises(DataError, match="No posterior"):
        stack({"bad": bad})


class Normal(Density):
    """N(mean, sd²) in every reference coordinate."""

    def __init__(self, mean, sd):
        self.distribution = torch.distributions.Normal(torch.tensor(mean), sd)

    def sample(self, num_samples):
        return self.distribution.sample((num_samples, 2))

    def log_prob(self, z):
        return self.distribution.log_prob(z).sum(-1)


class Unknown(Normal):
    """A density that cannot be evaluated."""

    def log_prob(self, z):
        return torch.full((len(z),), torch.nan)


@pytest.fixture
def two(linear, quick):
    """Two posteriors whose densities are known."""
    model, observed = linear
    posteriors = {}
    for label, mean in (("low", -2.0), ("high", 3.0)):
        posteriors[label] = npdr.infer(
            model, observed, backend=replace(quick, epochs=1), num_simulations=20, progress=False
        )
        posteriors[label].densities = (Normal(mean, 0.1), Normal(mean, 0.2))
    return model, posteriors


def test_the_stacked_posterior_is_the_weighted_mixture(two):
    _, posteriors = two
    stacked = StackedPosterior(posteriors, {"low": 0.25, "high": 0.75})
    draws = stacked.sample(1_000)["theta"]
    is_high = draws[:, 0] > 0.5
    # The shares are exact, in every leading part as well.
    assert int(is_high.sum()) == 750
    assert abs(int(is_high[:100].sum()) - 75) <= 2
    expected = torch.logaddexp(
        posteriors["low"].log_prob({"theta": draws}) + math.log(0.25),
        posteriors["high"].log_prob({"theta": draws}) + math.log(0.75),
    )
    torch.testing.assert_close(stacked.log_prob({"theta": draws}), expected)
    assert stacked.most_likely(200)["theta"][0] > 2
    assert stacked.backend_name == "0.25 low + 0.75 high"


def test_the_stacked_posterior_does_what_a_posterior_does(two):
    model, posteriors = two
    stacked = StackedPosterior(posteriors, {"low": 0.25, "high": 0.75})
    assert stacked.predict(10)["x"].shape == (10, 2)
    data = stacked.to_arviz(200)
    assert data["posterior"].sizes["chain"] == 1
    assert math.isnan(npdr.diagnose(data).r_hat)
    assert float((data["posterior"]["theta"][0, :, 0] > 0.5).mean()) == 0.75
    torch.manual_seed(0)
    drawn = Predictive(model, guide=stacked.guide, num_samples=400, parallel=True)()
    # One draw of the guide at a time must find every component too: binomial, 4 standard errors.
    single = torch.stack([stacked.guide()["theta"][0] for _ in range(400)])
    for theta in (drawn["theta"][..., 0], single):
        assert abs(float((theta > 0.5).double().mean()) - 0.75) < 4 * math.sqrt(0.1875 / 400)


def test_a_component_without_a_density_contributes_none(two):
    _, posteriors = two
    posteriors["low"].densities = (Unknown(-2.0, 0.1),)
    posteriors["low"].weights = torch.ones(1, dtype=torch.float64)
    stacked = StackedPosterior(posteriors, {"low": 0.5, "high": 0.5})
    at = {"theta": torch.full((3, 2), 3.0)}
    expected = posteriors["high"].log_prob(at) + math.log(0.5)
    torch.testing.assert_close(stacked.log_prob(at), expected)
    assert bool((posteriors["low"].log_prob(at) == -torch.inf).all())


def test_bad_mixtures_are_refused(two):
    _, posteriors = two
    for shares, sentence in (
        ({"low": 1.0}, "Every posterior needs a weight"),
        ({"low": 0.5, "high": 0.6}, "sum 1"),
        ({"low": -0.5, "high": 1.5}, "negative"),
    ):
        with pytest.raises(DataError, match=sentence):
            StackedPosterior(posteriors, shares)
