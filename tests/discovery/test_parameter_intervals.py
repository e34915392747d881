"""How sure parameters are: weighted draws where the normal approximation bends."""

from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hidden_rigs import make_case
from torch.distributions import MultivariateNormal

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.proof.parameter_intervals import (
    Draws,
    estimates,
    posterior_draws,
    quick_draws,
)
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import Spring
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.ridges import RidgeCoordinates
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from tests.helpers.pendulum_recordings import swinging


def fitted(effects):
    """A pendulum that lacks nothing, fitted with effects that it does not have."""
    case = make_case("pendulum", "null", (), seed=2001)
    data_options = segment_options(case.fit)
    return fit_hypothesis(case.model, case.fit, data_options, effects=effects)


def test_where_the_model_is_linear_they_are_those_of_laplaces_approximation():
    hypothesis = fitted(())
    draws = posterior_draws(hypothesis, seed=0)
    eye = torch.eye(len(hypothesis.fit.z), dtype=torch.float64)
    expected = torch.linalg.inv(hypothesis.likelihood.information() + eye)
    away = draws.z - draws.weights @ draws.z
    covariance = (draws.weights[:, None] * away).mT @ away
    # The variance of 400 independent draws is known to 7 %.
    assert torch.allclose(covariance.diagonal(), expected.diagonal(), rtol=0.25)


@pytest.mark.slow
def test_draws_follow_a_ridge_that_bends():
    # Of a spring that is hardly there, stiffness times rest is known, and neither of them.
    hypothesis = fitted((Spring("hinge"),))
    likelihood, centre = hypothesis.likelihood, hypothesis.fit.z
    draws = posterior_draws(hypothesis, seed=0)
    eye = torch.eye(len(centre), dtype=torch.float64)
    torch.manual_seed(0)
    normal = MultivariateNormal(centre, precision_matrix=likelihood.information() + eye)
    best = likelihood.log_prob(centre[None])
    drawn = 2.0 * (best - likelihood.log_prob(draws.z))
    straight = 2.0 * (best - likelihood.log_prob(normal.sample((200,))))
    # A posterior's draws are about as far from the best fit as there are parameters.
    assert float(draws.weights @ drawn) < 1.5 * len(centre)
    assert float(straight.mean()) > 1.3 * float(draws.weights @ drawn)


def test_rough_draws_do_not_look_for_ridges(monkeypatch):
    def fail(*_):
        raise AssertionError("looked for a ridge")

    hypothesis = fitted((Spring("hinge"),))
    monkeypatch.setattr(RidgeCoordinates, "_most_curved", fail)
    with pytest.raises(AssertionError, match="ridge"):
        posterior_draws(hypothesis, seed=0)
    draws = posterior_draws(hypothesis, seed=0, is_rough=True)
    assert bool(hypothesis.likelihood.log_prob(draws.z).isfinite().all())


def test_draws_are_taken_as_often_as_they_weigh():
    torch.manual_seed(0)
    draws = Draws(
        torch.arange(4.0)[:, None].double(), torch.tensor([0.5, 0.0, 0.25, 0.25]).double()
    )
    taken = draws.resampled(400)[:, 0]
    assert torch.bincount(taken.long(), minlength=4).tolist() == [200, 0, 100, 100]


@pytest.mark.parametrize("seed", [0, 1])
def test_intervals_hold_the_mass_they_say(seed):
    hypothesis = fitted(())
    found = estimates(hypothesis, posterior_draws(hypothesis, seed=seed), {})
    for estimate in found.values():
        low, high = estimate.hdi_94
        # Of a normal distribution, 94 % lie within 1.881 standard deviations.
        assert (high - low) / (2.0 * estimate.sd) == pytest.approx(1.881, rel=0.1)
        assert 0.5 * (low + high) == pytest.approx(estimate.mean, abs=0.2 * estimate.sd)


def exact(inputs):
    """A pendulum whose errors of integration are small compared with the noise."""
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    length = pyro.sample("length", dist.Uniform(0.3, 1.7))
    parameters = {"mass": mass, "length": length}
    return npdr.simulate("trajectory", Pendulum(integrator="rk4"), parameters, inputs)


def deviations(clean, rho):
    """Returns the reported standard deviations, with noise of this correlation from step to step.

    The first measurements have no noise, so that initial states are exact.
    """
    generator, noisy = np.random.default_rng(0), []
    for readings in clean.readings:
        noise = generator.standard_normal(readings.shape) * [0.01, 0.05]
        for k in range(1, len(noise)):
            noise[k] = rho * noise[k - 1] + (1.0 - rho**2) ** 0.5 * noise[k]
        noise[0] = 0.0
        noisy.append(readings + noise)
    rollouts = replace(clean, readings=tuple(noisy))
    hypothesis = fit_hypothesis(exact, rollouts, DataOptions(None, None, "recorded"))
    found = estimates(hypothesis, posterior_draws(hypothesis, seed=0), {})
    return {name: estimate.sd for name, estimate in found.items()}


def test_correlated_noise_makes_parameters_less_certain():
    clean = swinging(rollouts=8, steps=100, noise={"angle": 0.0, "velocity": 0.0})
    white, correlated = deviations(clean, 0.0), deviations(clean, 0.8)
    for name, sd in white.items():
        # The variance of a mean grows by (1 + ρ) / (1 − ρ). Its estimate by 16 series of 100
        # measurements, the noise and the draws have an error of about 8 % together.
        assert correlated[name] / sd == pytest.approx((1.8 / 0.2) ** 0.5, rel=0.25)


def test_draws_that_cannot_be_simulated_do_not_count(monkeypatch):
    hypothesis = fitted(())
    whitened, most = SegmentLikelihood.whitened, float(hypothesis.fit.z[0])

    def fails_beyond(self, z):
        return torch.where(z[:, :1] > most, torch.nan, whitened(self, z))

    monkeypatch.setattr(SegmentLikelihood, "whitened", fails_beyond)
    draws = posterior_draws(hypothesis, seed=0)
    assert float(draws.weights.sum()) == pytest.approx(1.0)
    assert float(draws.z[:, 0].max()) <= most


def test_a_ridge_is_traced_inside_the_support(monkeypatch):
    hypothesis, simulated = fitted((Spring("hinge"),)), []
    scores, to_reference = SegmentLikelihood.scores, RidgeCoordinates.to_reference

    def leaving(self, w):
        z, inside = to_reference(self, w)
        # As if the first chord step had carried every second point off the support.
        return (z, inside & (torch.arange(len(z)) % 2 == 0)) if simulated else (z, inside)

    def seen(self, z):
        simulated.append(len(z))
        return scores(self, z)

    def all_curved(self, likelihood, num):
        return torch.ones(num, dtype=torch.bool)

    def at_the_fit(likelihood, information):
        return likelihood.fit.z  # otherwise its scores are among the first that are seen

    monkeypatch.setattr("npdr_ppl.preparation.ridges._most_likely", at_the_fit)
    monkeypatch.setattr(RidgeCoordinates, "to_reference", leaving)
    monkeypatch.setattr(RidgeCoordinates, "_most_curved", all_curved)
    monkeypatch.setattr(SegmentLikelihood, "scores", seen)
    space = RidgeCoordinates.of(hypothesis.likelihood, seed=0)
    assert simulated[1] == (simulated[0] + 1) // 2
    assert bool(space.bend.coefficients.isfinite().all())


def test_draws_after_a_time_limit_are_not_simulated(monkeypatch):
    hypothesis = fitted(())
    exact, most = posterior_draws(hypothesis, seed=0), []
    log_prob = SegmentLikelihood.log_prob

    def counted(likelihood, z, *rest):
        most.append(len(z))
        return log_prob(likelihood, z, *rest)

    monkeypatch.setattr(SegmentLikelihood, "log_prob", counted)
    draws = quick_draws(hypothesis, seed=0)
    found, expected = (estimates(hypothesis, each, {}) for each in (draws, exact))
    for name, value in expected.items():
        assert abs(found[name].mean - value.mean) < 0.3 * value.sd
        assert 0.7 < found[name].sd / value.sd < 1.4
    assert max(most, default=0) < 100
