"""NUTS beyond the contract: which models it takes, and its density of measured channels only."""

import math
from functools import partial

import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import BackendError
from npdr_ppl.inference.nuts import NUTS
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.binding import bind, problem_of
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.randomness import seeded


def gain_model(noise):
    gain = pyro.sample("gain", dist.LogNormal(0.0, 1.0))
    return npdr.simulate("x", lambda gain: torch.log(gain)[:, None], {"gain": gain}, noise=noise)


@pytest.mark.slow
def test_samples_a_function_with_declared_noise():
    # log gain ~ N(0, 1) and x = log gain + 0.5 e: N(x / 1.25, 0.2).
    posterior = npdr.infer(
        partial(gain_model, 0.5),
        torch.tensor([1.0]),
        backend=NUTS(num_samples=400, warmup=100),
        progress=False,
    )
    log_gain = posterior.sample(800)["gain"].log()
    assert abs(log_gain.mean() - 0.8) < 4.5 * 0.2**0.5 / 100**0.5
    assert log_gain.std() == pytest.approx(0.2**0.5, rel=0.25)
    assert posterior.provenance.rounds[0].num_simulations == 0


def test_refuses_models_without_a_density():
    def counter():
        rate = pyro.sample("rate", dist.Uniform(1.0, 2.0))
        return npdr.simulate("x", torch.poisson, {"input": rate})

    def rounded():
        rate = pyro.sample("rate", dist.Uniform(1.0, 2.0))
        return npdr.simulate("x", lambda rate: rate.detach(), {"rate": rate}, noise=0.1)

    for model in (counter, rounded):
        with pytest.raises(BackendError, match="differentiable density"):
            npdr.infer(model, torch.tensor(1.0), backend="nuts", progress=False)


def test_absent_channels_do_not_count():
    noise = {"angle": 0.1, "velocity": 0.1}
    time = 0.02 * torch.arange(41)
    rollouts = {}
    for names in (("angle", "velocity"), ("angle",)):
        with seeded(0):
            readings = 0.2 * torch.randn(42, 2)[:, : len(names)]
        rollouts[names] = npdr.Rollouts.from_arrays(
            readings=[readings.double().numpy()],
            actions=[torch.sin(time)[:, None].double().numpy()],
            channel_names=names,
            action_names=("torque",),
            time_step=0.02,
        )
    z = torch.tensor([[0.1, -0.2], [0.5, 0.3]])
    values = {}
    for names, measured in rollouts.items():
        bound = bind(
            partial(pendulum, noise=noise), measured, DataOptions("all", None, "estimated")
        )
        log_likelihood = problem_of(bound).log_likelihood
        assert log_likelihood is not None
        values[names] = log_likelihood(z.requires_grad_())
        (gradient,) = torch.autograd.grad(values[names].sum(), z)
        assert gradient.isfinite().all() and gradient.abs().min() > 0
    # Each of the 41 absent readings would contribute at least its normalising constant.
    constant = -math.log(0.1 * (2 * math.pi) ** 0.5)
    assert (values["angle",] < 41 * constant).all()
    assert (values["angle", "velocity"] < 2 * 41 * constant).all()
    assert (values["angle", "velocity"] - values["angle",]).abs().min() > 1.0
