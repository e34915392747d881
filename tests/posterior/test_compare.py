"""compare: the same conditions for all, figures that closed forms give too, failures as rows."""

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import BackendError, DataError
from npdr_ppl.inference.base import Backend, Density, State
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.memory import STATM, sampled_memory
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior import infer as infer_module
from npdr_ppl.posterior.comparison.error_model import find_error_model, segment_log_likelihood
from npdr_ppl.posterior.comparison.predictive_scores import loo_elpd, predictive_elpd
from npdr_ppl.preparation.binding import bind
from npdr_ppl.preparation.closest_fit import closest_fit
from npdr_ppl.preparation.data_options import DataOptions

OPTIONS = DataOptions("all/10", 25, "recorded")


class Gaussian(Density):
    """N(mean, sd²) in every reference coordinate."""

    def __init__(self, mean, sd, num_parameters):
        self.distribution = torch.distributions.Normal(mean, sd)
        self.num_parameters = num_parameters

    def sample(self, num_samples):
        return self.distribution.sample((num_samples, self.num_parameters))

    def log_prob(self, z):
        return self.distribution.log_prob(z).sum(-1)


@dataclass(frozen=True)
class Fixed(Backend):
    """Always returns N(mean, sd²), for any simulations."""

    name: ClassVar[str] = "fixed"
    summary: ClassVar[str] = "a posterior known beforehand"
    state_class = State
    mean: float = 0.0
    sd: float = 0.1

    def init(self, problem):
        return State(0)

    def learn(self, problem, state, z, x, progress):
        return state, {}

    def densities(self, problem, state):
        return [Gaussian(self.mean, self.sd, problem.num_parameters)] * 2

    def tensors(self, state):
        return {"z": torch.zeros(1)}, {"round": state.round}

    def restore(self, problem, tensors, values: Mapping[str, Any]):
        return State(values["round"])


class AtOnce(Fixed):
    """Takes no rounds."""

    is_sequential = False


class Failing(Fixed):
    """Fails when it is told simulations."""

    def learn(self, problem, state, z, x, progress):
        raise BackendError("It does not like these simulations.")


def run(model, train, test, backends, **settings):
    settings = {"rounds": 1, "num_simulations": 20, "progress": False} | settings
    return npdr.compare(model, train, test, backends=backends, **settings)


# The reference coordinate of a uniform parameter is Φ⁻¹ of its quantile: mass and length 1 of the
# pendulum's Uniform(0.3, 1.7) are at 0.
NEAR, FAR = Fixed(0.0, 0.1), Fixed(1.5, 0.1)


@pytest.mark.slow
def test_the_better_posterior_wins_everywhere(recording, tmp_path):
    found = run(
        pendulum, recording[[0]], recording[[1]], {"far": FAR, "near": NEAR},
        options=OPTIONS, out=tmp_path,
    )  # fmt: skip
    assert found.ranking == ["near", "far"]
    assert found.ranks == {"near": 1, "far": 2}
    near, far = found.rows["near"].figures, found.rows["far"].figures
    assert near.elpd.shape == (4,), "one density per segment of 25 steps"
    assert near.elpd.sum() > far.elpd.sum()
    assert near.rmse < far.rmse and near.dtw < far.dtw and near.crps < far.crps
    # The readings' noise is in the prediction: four standard errors of 200 readings.
    assert abs(near.coverage[0.95] - 0.95) < 0.06
    assert far.coverage[0.95] < near.coverage[0.95]
    assert found.weights["near"] > 0.99
    written = json.loads((tmp_path / "comparison.json").read_text())
    assert written["ranking"] == ["near", "far"]
    assert {"rmse", "dtw", "elpd", "r_hat", "seconds"} <= set(written["backends"]["far"])
    assert set(written["backends"]["near"]["seconds"]) == {"simulate", "train", "sample"}
    assert set(written["backends"]["near"]["coverage"]) == {"50", "80", "95"}
    assert (tmp_path / "near" / "posterior.nc").stat().st_size > 1_000
    assert found.ensemble.sample(10)["mass"].shape == (10,)


def test_elpd_has_its_closed_form():
    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
        npdr.simulate("x", lambda theta: theta, {"theta": theta}, noise=0.5)

    train, test = torch.tensor([0.8, -0.4]), torch.tensor([0.9, 0.1])
    backends = {"a": Fixed(0.5, 0.3), "b": Fixed(-0.2, 0.3)}
    found = run(model, train, test, backends)
    for label, method in backends.items():
        spread = math.hypot(method.sd, 0.5)
        exact = torch.distributions.Normal(method.mean, spread).log_prob(test).sum()
        draws = found.rows[label].figures.elpd_draws
        # The mean of p(y | ξ) over 1000 draws has the relative error sqrt(1/n_eff − 1/n).
        tolerance = 4 * math.sqrt(1 / draws - 1 / 1_000)
        assert abs(found.rows[label].figures.elpd.sum() - exact) < tolerance
        assert found.rows[label].figures.rmse == ()
    assert found.ranking == ["a", "b"]


def test_leaving_out_has_its_closed_form():
    # y_i ~ N(θ, 1), flat prior: the posterior of all is N(ȳ, 1/n), without i N(ȳ₋ᵢ, 1/(n − 1)).
    generator = torch.Generator().manual_seed(0)
    y = torch.randn(40, generator=generator, dtype=torch.float64)
    n = len(y)
    theta = y.mean() + torch.randn(4_000, generator=generator, dtype=torch.float64) / n**0.5
    likelihood = torch.distributions.Normal(theta[:, None], 1.0).log_prob(y)
    others = (y.sum() - y) / (n - 1)
    exact = torch.distributions.Normal(others, (1 + 1 / (n - 1)) ** 0.5).log_prob(y)
    assert np.abs(loo_elpd(likelihood) - exact.numpy()).max() < 0.02
    # What the draws have seen looks better than it is.
    assert predictive_elpd(likelihood).sum() > exact.sum() + 0.5


def test_failed_draws_cost_density_and_nothing_else():
    likelihood = torch.tensor([[0.0, -1.0], [-torch.inf, -torch.inf]], dtype=torch.float64)
    np.testing.assert_allclose(predictive_elpd(likelihood), [-math.log(2), -1 - math.log(2)])
    nothing = torch.full((3, 2), -torch.inf, dtype=torch.float64)
    assert (predictive_elpd(nothing) == -np.inf).all()
    assert (loo_elpd(nothing) == -np.inf).all()


def test_the_error_model_is_that_of_the_fitted_recording(recording):
    train = recording[[0]]
    found = find_error_model(pendulum, train, OPTIONS, seed=1)
    assert found.noise == closest_fit(pendulum, train, OPTIONS, seed=1).scale
    assert set(found.share) == {"angle", "velocity"}
    assert all(1 / 25 <= share <= 1 for share in found.share.values())
    # A model with noise keeps it; one that is to stay as it is, is judged with noise all the same.
    noisy = with_noise(pendulum, {"angle": 0.05, "velocity": 0.2})
    assert find_error_model(noisy, train, OPTIONS).fitted is noisy
    assert find_error_model(noisy, train, OPTIONS).noise is None
    untouched = find_error_model(
        pendulum, train, dataclasses.replace(OPTIONS, noise="model"), seed=1
    )
    assert untouched.fitted is pendulum
    assert untouched.noise == found.noise


def test_the_likelihood_of_a_segment_is_its_weighted_readings(recording):
    noise = {"angle": 0.05, "velocity": 0.2}
    share = {"angle": 0.5, "velocity": 0.1}
    bound = bind(with_noise(pendulum, noise), recording[[0]], OPTIONS)
    z = torch.tensor([[0.0, 0.0], [0.3, -0.2]], dtype=torch.float64)
    exact = bind(pendulum, recording[[0]], OPTIONS).prior.execute(z)["trajectory"]
    observed = bound.observations["trajectory"].value
    expected = torch.zeros(2, 4, dtype=torch.float64)
    for c, channel in enumerate(noise):
        density = torch.distributions.Normal(exact[..., c], noise[channel])
        expected += share[channel] * density.log_prob(observed[..., c]).sum(-1)
    found = segment_log_likelihood(bound, z, share)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_all_get_the_same_budget(recording):
    found = run(
        pendulum, recording, None,
        {"near": NEAR, "at once": AtOnce(0.2), "c": "snpe-c(epochs=1, transforms=1)"},
        rounds=2, options=OPTIONS,
    )  # fmt: skip
    assert {row.num_simulations for row in found.rows.values()} == {40}
    assert [row.rounds for row in found.rows.values()] == [2, 1, 2]
    assert found.settings["elpd"] == "PSIS-LOO", "without held-out data each segment is left out"


@pytest.mark.slow
def test_failures_are_rows_unless_all_fail(recording, tmp_path):
    train, test = recording[[0]], recording[[1]]
    backends = {"failing": Failing(), "near": NEAR}
    found = run(pendulum, train, test, backends, options=OPTIONS, out=tmp_path)
    assert found.ranking == ["near"]
    assert found.weights == {"near": 1.0}
    row = json.loads((tmp_path / "comparison.json").read_text())["backends"]["failing"]
    assert row["error"] == "It does not like these simulations."
    assert row["rmse"] is None and row["seconds"] is None
    with pytest.raises(BackendError, match="Every backend failed. failing: It does not like"):
        run(pendulum, train, test, {"failing": Failing()}, options=OPTIONS)


@pytest.mark.slow
def test_equal_backends_share_their_place(recording):
    backends = {"far": FAR, "b": NEAR, "a": replace(NEAR)}
    found = run(pendulum, recording[[0]], recording[[1]], backends, options=OPTIONS)
    assert found.ranking == ["b", "a", "far"]
    assert found.ranks == {"b": 1, "a": 1, "far": 3}


@pytest.mark.slow
def test_an_impossible_prediction_is_null_and_last(recording, tmp_path):
    def stops_at_the_edge(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        broken = torch.where(mass > 1.6, torch.nan, mass)
        return npdr.simulate("trajectory", simulator(), {"mass": broken}, inputs)

    def simulator():
        from npdr_ppl.models.pendulum import Pendulum

        return Pendulum()

    found = run(
        stops_at_the_edge, recording[[0]], recording[[1]],
        {"impossible": Fixed(4.0, 0.01), "near": NEAR}, options=OPTIONS, out=tmp_path,
    )  # fmt: skip
    assert found.ranking == ["near", "impossible"]
    written = json.loads((tmp_path / "comparison.json").read_text())
    assert written["backends"]["impossible"]["elpd"] is None
    assert written["backends"]["impossible"]["crps"] is None
    assert written["weights"] == {"impossible": 0.0, "near": 1.0}


def test_without_a_likelihood_the_crps_ranks(linear):
    _, observed = linear

    def model():
        theta = pyro.sample("theta", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
        npdr.simulate("x", lambda theta: theta + 0.5 * torch.randn_like(theta), {"theta": theta})

    found = run(model, observed, observed, {"off": Fixed(2.0, 0.1), "near": Fixed(0.2, 0.5)})
    assert found.ranking == ["near", "off"]
    assert found.weights == {}
    with pytest.raises(BackendError, match="no stacking weights"):
        _ = found.ensemble


@pytest.mark.slow
def test_the_mixtures_density_is_better_than_any_ones(recording):
    backends = {"low": Fixed(-0.4, 0.05), "high": Fixed(0.4, 0.05)}
    found = run(pendulum, recording[[0]], recording[[1]], backends, options=OPTIONS)
    best = max(row.figures.elpd.sum() for row in found.rows.values())
    assert found.mixture.elpd.sum() >= best - 1e-6


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures_and_a_killed_run_continues(
    recording, quick, tmp_path, monkeypatch
):
    arguments = {"rounds": 2, "num_simulations": 60, "seed": 3, "options": OPTIONS}
    backends = {"a": replace(quick, epochs=3), "b": replace(quick, flow="maf", epochs=3)}
    train, test = recording[[0]], recording[[1]]
    expected = run(pendulum, train, test, backends, **arguments)

    class Killed(Exception):
        pass

    real, calls = infer_module.simulate_features, []

    def dies_in_the_last_round(*args, **kwargs):
        calls.append(args)
        if len(calls) == 4:
            raise Killed
        return real(*args, **kwargs)

    monkeypatch.setattr(infer_module, "simulate_features", dies_in_the_last_round)
    with pytest.raises(Killed):
        run(pendulum, train, test, backends, out=tmp_path, **arguments)
    resumed = run(pendulum, train, test, backends, out=tmp_path, **arguments)
    assert len(calls) == 5, "rounds that were complete are not simulated again"
    for label in backends:
        assert resumed.rows[label].figures.rmse == expected.rows[label].figures.rmse
        np.testing.assert_array_equal(
            resumed.rows[label].figures.elpd, expected.rows[label].figures.elpd
        )
    assert resumed.weights == expected.weights
    # Backends may be added to a comparison, but not to another one.
    more = run(pendulum, train, test, backends | {"c": NEAR}, out=tmp_path, **arguments)
    assert set(more.rows) == {"a", "b", "c"} and len(calls) == 7
    with pytest.raises(DataError, match="differs in seed"):
        run(pendulum, train, test, backends, out=tmp_path, **(arguments | {"seed": 4}))


def test_bad_data_are_refused_at_once(recording):
    with pytest.raises(DataError, match="velocity was not recorded"):
        run(pendulum, recording.select(["angle"]), None, [NEAR], options=OPTIONS)


@pytest.mark.skipif(not STATM.exists(), reason="the system does not say how large a process is")
def test_memory_is_sampled():
    with sampled_memory() as small:
        pass
    with sampled_memory() as large:
        block = np.ones(2**25 // 8 * 4)  # 128 MiB
    assert small.peak < 32
    assert 120 < large.peak < 200
    del block
