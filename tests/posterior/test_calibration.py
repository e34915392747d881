"""Calibration, on a linear-Gaussian problem whose posterior can be exact or wrong on purpose."""

import json
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.arviz_module import group
from npdr_ppl.errors import BackendError, DataError, SimulationError
from npdr_ppl.inference.base import Backend, Density, State
from npdr_ppl.inference.registry import backend
from npdr_ppl.posterior.calibration.calibration_result import Calibration

GAIN = torch.tensor([[1.0, 0.4], [0.0, 1.0], [0.5, -0.5]])
NOISE = 0.7
FALSE_ALARM = 1e-3
"""Level of all tests together at which the calibrated posterior must pass and others fail."""


def model(failing=0.0):
    def simulator(a, b):
        x = torch.stack((a, b), -1) @ GAIN.T + NOISE * torch.randn(len(a), 3)
        return torch.where(torch.rand(len(a), 1) < failing, math.nan, x)

    # Two coordinates of z that map to parameters nonlinearly.
    a = pyro.sample("a", dist.LogNormal(0.0, 1.0))
    b = pyro.sample("b", dist.Normal(0.0, 2.0))
    npdr.simulate("x", simulator, {"a": a.log(), "b": b / 2})


class Gaussian(Density):
    def __init__(self, mean, covariance):
        self.normal = torch.distributions.MultivariateNormal(mean, covariance)

    def sample(self, num_samples):
        return self.normal.sample((num_samples,))

    def log_prob(self, z):
        return self.normal.log_prob(z)


@dataclass(frozen=True)
class Exact(Backend):
    """The posterior from the joint Gaussian's precision, or a distortion of it."""

    name: ClassVar[str] = "exact"
    summary: ClassVar[str] = "for tests"
    amortises: ClassVar[bool] = True
    state_class = State

    scale: float = 1.0
    shift: float = 0.0
    is_prior: bool = False
    members: int = 2

    def init(self, problem):
        return State(0)

    def learn(self, problem, state, z, x, progress):
        return state, {}

    def densities(self, problem, state):
        if self.is_prior:
            return [Gaussian(torch.zeros(2), torch.eye(2))]
        covariance = (torch.eye(2) + GAIN.T @ GAIN / NOISE**2).inverse()
        mean = covariance @ GAIN.T @ problem.observation / NOISE**2
        mean = mean + self.shift * covariance.diagonal().sqrt()
        return [Gaussian(mean, self.scale**2 * covariance) for _ in range(self.members)]


class NotAmortised(Exact):
    amortises: ClassVar[bool] = False


OBSERVED = torch.tensor([0.4, -0.2, 0.5])


def posterior_of(method, rounds=1, failing=0.0):
    return npdr.infer(
        lambda: model(failing), OBSERVED, backend=method, rounds=rounds, num_simulations=50,
        progress=False,
    )  # fmt: skip


def calibrated(method, **arguments):
    arguments = {"num_datasets": 300, "num_draws": 199, "seed": 1, "progress": False} | arguments
    return npdr.calibrate(posterior_of(method), **arguments)


@pytest.mark.slow
def test_an_exact_posterior_passes():
    found = calibrated(Exact())
    assert found.passes(FALSE_ALARM)
    assert found.num_datasets == 300 and found.num_failed == 0
    assert "No sign of miscalibration" in found.summary
    for of in ("a", "b", "highest_density", "tarp"):
        # Every nominal level lies in its 99.99 % interval: 12 intervals, one false alarm in 800.
        for level in found.coverage((0.5, 0.8, 0.95), of, confidence=0.9999):
            assert level.low <= level.nominal <= level.high


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "sign"), [(0.6, 1), (1.6, -1)])
def test_wrong_widths_fail_every_test(scale, sign):
    found = calibrated(Exact(scale=scale))
    assert set(found.failures(FALSE_ALARM)) == {"a", "b", "highest_density", "tarp"}
    for of in ("a", "b", "highest_density"):
        for level in found.coverage((0.5, 0.8), of):
            assert sign * (level.nominal - level.expected) > 0
            assert not level.low <= level.nominal <= level.high
    assert "Miscalibrated over 300 simulated data sets: a (p = " in found.summary
    # A Gaussian's central 80 % hold 2 Phi(1.28 scale) - 1 of the truths; four standard errors.
    (central,) = found.coverage((0.8,), "a")
    expected = math.erf(1.2816 * scale / math.sqrt(2))
    assert abs(central.expected - expected) < 4 * math.sqrt(expected * (1 - expected) / 300)


@pytest.mark.slow
def test_a_bias_fails_every_test():
    found = calibrated(Exact(shift=0.7))
    assert set(found.failures(FALSE_ALARM)) == {"a", "b", "highest_density", "tarp"}
    assert found.ranks.mean() < found.num_draws / 2, "truths lie below a posterior shifted up"


@pytest.mark.slow
def test_only_tarp_sees_the_prior_in_place_of_the_posterior():
    found = calibrated(Exact(is_prior=True))
    assert set(found.failures(FALSE_ALARM)) == {"tarp"}
    assert found.tarp_deviation > 0.2


@pytest.mark.slow
def test_failed_simulations_are_dropped_and_counted():
    posterior = posterior_of(Exact(), failing=0.2)
    found = npdr.calibrate(posterior, num_datasets=400, num_draws=99, progress=False)
    assert found.num_datasets + found.num_failed == 400
    assert abs(found.num_failed - 80) < 4 * math.sqrt(400 * 0.2 * 0.8)
    assert found.passes(FALSE_ALARM)
    assert f"({found.num_failed} more failed)" in found.summary
    with pytest.raises(SimulationError, match="finite; calibration needs 20"):
        npdr.calibrate(posterior_of(Exact(), failing=0.9), num_datasets=40, progress=False)


@pytest.mark.slow
def test_posteriors_of_one_observation_must_be_refitted():
    sequential = posterior_of(Exact(), rounds=2)
    with pytest.raises(BackendError, match=r"took 2 rounds.*refit=True.*after_round\(0\)"):
        npdr.calibrate(sequential)
    assert npdr.calibrate(sequential.after_round(0), num_datasets=20, progress=False)
    with pytest.raises(BackendError, match="exact holds for its own observation only"):
        npdr.calibrate(posterior_of(NotAmortised()))
    found = npdr.calibrate(sequential, refit=True, num_draws=99, progress=False)
    assert found.is_refit and found.num_datasets == 50
    assert found.passes(FALSE_ALARM)
    wrong = npdr.calibrate(
        posterior_of(NotAmortised(scale=0.5)), refit=True, num_draws=99, progress=False
    )
    assert "highest_density" in wrong.failures(FALSE_ALARM)


@pytest.mark.slow
def test_refits_learn_from_the_simulated_observation(linear):
    model, observed = linear
    tiny = backend("snpe-c", transforms=1, hidden=(8,), epochs=3, members=1)
    posterior = npdr.infer(
        model, observed, backend=tiny, rounds=2, num_simulations=100, progress=False
    )
    found = npdr.calibrate(
        posterior, refit=True, num_datasets=20, num_draws=99, seed=2, progress=False
    )
    # A posterior of the recording instead would hold 95 % of truths from the prior in a quarter
    # of the data sets; the share has a standard error of 0.05 at 0.95.
    assert found.coverage((0.95,))[0].expected > 0.7


@pytest.mark.slow
def test_amortised_flows_are_evaluated_at_every_observation(linear, quick):
    model, observed = linear
    posterior = npdr.infer(
        model, observed, backend=quick, num_simulations=500, seed=1, progress=False
    )
    problem, state = posterior.problem, posterior.states[-1]
    observations = torch.tensor([[0.1, 0.2], [-1.0, 0.5]])
    z = torch.randn(4, 2)
    given = list(quick.densities_given(problem, state, observations))
    for x, members in zip(observations, given, strict=True):
        alone = quick.densities(replace(problem, observation=x), state)
        for one, other in zip(members, alone, strict=True):
            assert torch.equal(one.log_prob(z), other.log_prob(z))
    found = npdr.calibrate(posterior, num_datasets=100, num_draws=99, progress=False)
    assert found.parameters == ("theta[0]", "theta[1]")
    assert found.coverage((0.8,))[0].expected > 0.6


@pytest.mark.slow
def test_same_seed_same_ranks_and_the_callers_stream_is_left_alone():
    few = {"num_datasets": 20, "num_draws": 19}
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    first = calibrated(Exact(), **few)
    assert torch.equal(torch.rand(2), expected)
    again, other = calibrated(Exact(), **few), calibrated(Exact(), **few, seed=2)
    assert first.to_dict() == again.to_dict()
    assert (first.ranks != other.ranks).any()
    thinned = calibrated(Exact(), **few, thin=3)
    assert thinned.ranks.max() <= 19 and (thinned.ranks != first.ranks).any()


def test_coverage_has_exact_intervals():
    ranks = np.arange(10) * 100 + 50
    found = Calibration(("a",), ranks[:, None], ranks, ranks, 999, 0, False, 0)
    (half,) = found.coverage((0.5,))
    assert half.expected == 0.5
    (nothing,) = found.coverage((0.01,))
    assert (nothing.expected, nothing.low) == (0.0, 0.0)
    assert nothing.high == pytest.approx(1 - 0.025 ** (1 / 10))
    # The central 20 % around the middle hold the ranks 450 and 550.
    assert found.coverage((0.2,), "a")[0].expected == 0.2
    assert found.tarp_deviation == pytest.approx(0.0505)
    with pytest.raises(DataError, match="no ranks of 'b'"):
        found.coverage(of="b")


def test_results_go_to_json_and_arviz():
    found = calibrated(Exact(), num_datasets=20, num_draws=19)
    loaded = json.loads(json.dumps(found.to_dict()))
    assert loaded["passes"] is True
    assert loaded["ranks"]["tarp"] == found.distance_ranks.tolist()
    data = found.to_arviz()
    pit = group(data, "prior_sbc")["a"]
    assert dict(pit.sizes) == {"chain": 1, "draw": 20}
    assert float(pit.min()) > 0 and float(pit.max()) < 1
    assert group(data, "ranks")["highest_density"].values[0].tolist() == (
        found.density_ranks.tolist()
    )


def test_arguments_out_of_range_are_refused():
    for wrong in ({"num_datasets": 0}, {"num_datasets": 5}, {"num_draws": 0}, {"thin": 0}):
        with pytest.raises(BackendError, match="at least 20 data sets"):
            calibrated(Exact(), **wrong)
