"""Learned likelihoods inside other programs, against the tractable model."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import MCMC, NUTS, SVI, Trace_ELBO
from pyro.infer.autoguide import AutoNormal

import npdr_ppl as npdr
from npdr_ppl.errors import BackendError, ModelError
from npdr_ppl.inference.registry import backend
from npdr_ppl.randomness import seeded

NOISE = 0.4


def sensor(gain):
    return torch.stack((gain, 0.5 * gain), -1) + NOISE * torch.randn(len(gain), 2)


def one():
    gain = pyro.sample("gain", dist.Normal(0.0, 1.5))
    return npdr.simulate("x", sensor, {"gain": gain})


def series():
    mean = pyro.sample("mean", dist.Normal(0.0, 1.0))
    with pyro.plate("device", 4, dim=-1):
        gain = pyro.sample("gain", dist.Normal(mean, 0.5))
        with pyro.plate("rollout", 2, dim=-2):
            return npdr.simulate("x", sensor, {"gain": gain})


LEARNERS = {
    # One flow is enough of a Gaussian, and samplers call it thousands of times.
    "nle": backend("nle", transforms=1, hidden=(32,)),
    "nre": backend("nre"),
}


@pytest.fixture(scope="module", params=LEARNERS)
def learnt(request):
    learner = LEARNERS[request.param]
    return npdr.infer(one, torch.zeros(2), backend=learner, num_simulations=3000, progress=False)


@pytest.fixture(scope="module")
def measured():
    with seeded(5):
        return {"x": pyro.condition(series, {"mean": torch.tensor(0.8)})()}


def test_log_prob_is_the_likelihood_up_to_a_function_of_the_value(learnt, measured):
    gains = torch.linspace(-1.0, 2.0, 4)

    def log_prob(gain):
        data = measured | {"gain": gain, "mean": torch.tensor(0.0)}
        model = pyro.condition(npdr.with_likelihood(series, learnt), data)
        return pyro.poutine.trace(model).get_trace().nodes["x"]["fn"].log_prob(measured["x"])

    found = log_prob(gains) - log_prob(gains + 0.4)
    assert found.shape == (2, 4)

    def exact(gain):
        mean = torch.stack((gain, 0.5 * gain), -1)
        return dist.Normal(mean, NOISE).to_event(1).log_prob(measured["x"])

    # Over a step of 0.4, one scatter of a reading: the errors of learning from 3000 simulations
    # must be small against the nat or more by which likelihoods differ there.
    torch.testing.assert_close(
        found, (exact(gains) - exact(gains + 0.4)).double(), rtol=0.1, atol=0.3
    )


@pytest.mark.slow
def test_nuts_and_svi_run_on_a_hierarchical_model(learnt, measured):
    # The exact posterior of the mean: each device's weighted average is sufficient.
    weights = torch.tensor([1.0, 0.5])
    estimate = (measured["x"] * weights).sum(-1).mean(0) / weights.square().sum()
    variance = 0.5**2 + NOISE**2 / (2 * weights.square().sum())
    precision = 1 + 4 / variance
    exact_mean, exact_sd = (estimate.sum() / variance / precision), precision**-0.5
    model = pyro.condition(npdr.with_likelihood(series, learnt), measured)
    with seeded(0):
        # Short trajectories, which mix about as well in six dimensions and take half the time.
        kernel = NUTS(model, max_tree_depth=2)
        sampler = MCMC(kernel, num_samples=300, warmup_steps=100, disable_progbar=True)
        sampler.run()
    draws = sampler.get_samples()["mean"]
    # Some hundred independent draws: 4.5 standard errors are 0.3 to 0.45 of the mean's and about
    # as much of the standard deviation's, which leaves nothing to the learning.
    assert abs(draws.mean() - exact_mean) < 0.35 * exact_sd
    assert 0.75 < draws.std() / exact_sd < 1.35

    pyro.clear_param_store()
    with seeded(1):
        guide = AutoNormal(model)
        svi = SVI(model, guide, pyro.optim.Adam({"lr": 0.05}), Trace_ELBO())
        losses = [svi.step() for _ in range(150)]
    assert sum(losses[-20:]) < sum(losses[:20])
    pyro.clear_param_store()


def test_is_zero_outside_what_was_simulated():
    def bounded():
        gain = pyro.sample("gain", dist.Uniform(0.0, 1.0))
        return npdr.simulate("x", sensor, {"gain": gain})

    learnt = npdr.infer(
        bounded, torch.zeros(2), backend="nle", num_simulations=200, progress=False
    )
    for gain, is_finite in ((0.5, True), (1.5, False)):
        data = {"gain": torch.tensor(gain), "x": torch.zeros(2)}
        model = pyro.condition(npdr.with_likelihood(one, learnt), data)
        log_prob = pyro.poutine.trace(model).get_trace().nodes["x"]["fn"].log_prob(data["x"])
        assert bool(log_prob.isfinite()) == is_finite
        assert not math.isnan(log_prob)


def test_refuses_what_was_not_learnt(learnt):
    def other():
        gain = pyro.sample("gain", dist.Normal(0.0, 1.0))
        return npdr.simulate("x", lambda gain, bias: gain + bias, {"gain": gain, "bias": gain})

    def longer():
        gain = pyro.sample("gain", dist.Normal(0.0, 1.0))
        return npdr.simulate("x", sensor, {"gain": gain})

    def run(model, value):
        conditioned = pyro.condition(npdr.with_likelihood(model, learnt), {"x": value})
        return pyro.poutine.trace(conditioned).get_trace().log_prob_sum()

    # Pyro adds its table of shapes to errors of a density.
    with pytest.raises(ValueError, match="differ in bias"):
        run(other, torch.zeros(2))
    with pytest.raises(ValueError, match="learnt likelihood is of values of shape"):
        run(longer, torch.zeros(3))
    with pytest.raises(ModelError, match="no black-box site 'y'"):
        npdr.with_likelihood(one, learnt, site="y")()


def test_refuses_a_posterior_estimator():
    posterior = npdr.infer(
        one, torch.zeros(2), backend="snpe-c", num_simulations=100, progress=False
    )
    with pytest.raises(BackendError, match="holds for one prior only"):
        npdr.with_likelihood(series, posterior)
