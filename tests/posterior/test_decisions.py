"""Each decision is reached by a real posterior of a real recording, for the right reason."""

from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.arviz_module import from_netcdf, to_netcdf
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.posterior.diagnostics import Decision, Thresholds
from npdr_ppl.posterior.fit import fit
from tests.helpers.pendulum_recordings import TRUTH, product, swinging


@pytest.fixture(scope="module")
def quick():
    """A backend that learns fast and little: what it gets wrong is to be noticed."""
    return backend("snpe-a", epochs=10, members=2, components=1)


@pytest.fixture(scope="module")
def clean():
    return swinging()


@pytest.fixture(scope="module")
def found(clean, quick):
    """The posterior of a model that lacks nothing."""
    return infer(pendulum, clean, quick)


def infer(model, rollouts, quick, **options):
    return npdr.infer(
        model, rollouts, backend=quick, num_simulations=200, progress=False, **options
    )


def inside(posterior, name, value, mass=0.999):
    """Whether a value lies in the central interval of a mass."""
    draws = posterior.sample(2_000)[name]
    low, high = np.quantile(draws.numpy(), [0.5 * (1.0 - mass), 0.5 * (1.0 + mass)])
    return low < value < high


@pytest.mark.slow
def test_defaults_find_the_truth_and_accept(found):
    for name, value in TRUTH.items():
        assert inside(found, name, value)
        # The simulator's own steps of 20 ms would bias both by several per cent.
        assert found.sample(500)[name].mean() == pytest.approx(value, rel=0.01)
    diagnosis = npdr.diagnose(found.to_arviz())
    assert diagnosis.decision is Decision.ACCEPT, diagnosis.reason
    assert found.preparation.are_steps_coarse
    assert "uncertain initial states" in found.preparation.sentence()


@pytest.mark.slow
def test_discovery_agrees_that_nothing_is_missing(clean, found):
    discovery = npdr.discover(pendulum, clean)
    assert discovery.verdict == "none", discovery.reason
    checks = found.checks()
    assert checks["model"]["p_value"] == discovery.alarm.p_value
    assert checks["priors"] == []


@pytest.mark.slow
def test_a_prior_that_excludes_the_truth_is_named(clean, quick):
    def narrow(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
        length = pyro.sample("length", dist.Uniform(0.3, 0.8))
        parameters = {"mass": mass, "length": length}
        return npdr.simulate("trajectory", Pendulum(), parameters, inputs)

    diagnosis = npdr.diagnose(infer(narrow, clean, quick).to_arviz())
    assert diagnosis.decision is Decision.WIDEN
    assert "length is at the upper end of its prior, Uniform(0.3, 0.8)" in diagnosis.reason
    found = npdr.discover(narrow, clean)
    assert found.effects == []
    assert found.reason.startswith("length is at the upper end")
    assert "with_wider_priors(revised_model, ['length'])" in found.source()


@pytest.mark.slow
def test_hidden_dry_friction_asks_for_another_model(quick):
    rubbing = swinging(friction=0.15)
    diagnosis = npdr.diagnose(infer(pendulum, rubbing, quick).to_arviz())
    assert diagnosis.decision is Decision.REVISE_MODEL
    assert diagnosis.model_p_value < 0.01


@pytest.mark.slow
def test_a_parameter_that_does_nothing_asks_for_another_rollout(clean, quick):
    def with_idle(inputs):
        pyro.sample("idle", dist.Uniform(0.0, 1.0))
        return pendulum(inputs)

    data = infer(with_idle, clean, quick).to_arviz()
    diagnosis = npdr.diagnose(data)
    assert diagnosis.decision is Decision.NEW_ROLLOUT
    assert "nothing of idle" in diagnosis.reason
    # Where nothing more can be recorded the others are used all the same.
    assert npdr.diagnose(data, rollouts_left=0).decision is Decision.ACCEPT


@pytest.mark.slow
def test_parameters_of_one_product_ask_for_another_excitation(clean, quick):
    posterior = infer(product, clean, quick)
    draws = posterior.sample(500)
    # A thin ridge: the product is known fifty times better than its factors.
    assert (draws["density"] * draws["volume"]).log().std() < 0.02 * draws["density"].log().std()
    diagnosis = npdr.diagnose(posterior.to_arviz(), Thresholds(contraction=0.4))
    assert diagnosis.decision is Decision.OTHER_EXCITATION
    assert "density and volume only in combination" in diagnosis.reason


@pytest.mark.slow
def test_declared_noise_that_is_too_small_is_told(clean, quick):
    model = npdr.with_noise(pendulum, {"angle": 0.001, "velocity": 0.005})
    diagnosis = npdr.diagnose(infer(model, clean, quick).to_arviz())
    assert diagnosis.decision is Decision.REVISE_MODEL
    assert "times as large as the declared noise" in diagnosis.reason


@pytest.mark.slow
def test_a_fit_spends_the_rounds_that_it_has_left(clean, quick, monkeypatch):
    from npdr_ppl.posterior import estimator_check
    from npdr_ppl.preparation import importance_sampling as posterior_sampling

    # Neither is given the draws that it takes to agree with the simulator.
    few = replace(
        posterior_sampling.IMPORTANCE_SAMPLING,
        most_iterations=1, draws_per_iteration=8, draws_of_given=8,
    )  # fmt: skip
    monkeypatch.setattr(posterior_sampling, "IMPORTANCE_SAMPLING", few)
    fewer = replace(estimator_check.ESTIMATOR_CHECK, num_draws=16)
    monkeypatch.setattr(estimator_check, "ESTIMATOR_CHECK", fewer)
    posterior, result = fit(
        pendulum, clean, backend=quick, rounds=1, extra_rounds=1, num_simulations=100,
        progress=False,
    )  # fmt: skip
    assert result["diagnosis"]["decision"] == Decision.MORE_ROUNDS
    assert "Pareto k" in result["diagnosis"]["reason"]
    assert len(posterior.provenance.rounds) == 2


@pytest.mark.slow
def test_checks_travel_with_the_exported_posterior(found, tmp_path):
    data = found.to_arviz()
    to_netcdf(data, tmp_path / "posterior.nc")
    again = npdr.diagnose(from_netcdf(tmp_path / "posterior.nc"))
    assert again.to_dict() == npdr.diagnose(data).to_dict()


def test_a_corrected_posterior_is_kept_on_disk(found, tmp_path):
    assert found.correction is not None
    found.save(tmp_path)
    loaded = npdr.Posterior.load(tmp_path, pendulum)
    for name, value in found.sample(50).items():
        assert torch.equal(loaded.sample(50)[name], value)
    assert loaded.checks() == found.checks()


@pytest.mark.slow
def test_nuts_integrates_initial_states_out(quick):
    short = swinging(rollouts=1, steps=100)
    exact = npdr.infer(
        pendulum, short, backend=backend("nuts", chains=1, num_samples=50, warmup=30),
        progress=False,
    )  # fmt: skip
    other = infer(pendulum, short, quick)
    for name in TRUTH:
        one, two = exact.sample(50)[name], other.sample(2_000)[name]
        # Standard errors of both, and of 50 draws that are not independent.
        assert abs(float(one.mean() - two.mean())) < 0.6 * float(two.std())
        assert float(one.std() / two.std()) == pytest.approx(1.0, abs=0.4)
