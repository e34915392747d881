"""Each decision of `fit` is reached by the posterior of a recording, for its own reason."""

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.arviz_module import from_netcdf, to_netcdf
from npdr_ppl.inference.registry import backend
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.diagnostics import Decision
from npdr_ppl.posterior.fit import fit
from tests.helpers.pendulum_recordings import TRUTH, links, swinging, too_short, with_idle


@pytest.fixture(scope="module")
def quick():
    """A backend that learns fast and little: what it gets wrong is to be noticed."""
    return backend("snpe-a", epochs=10, members=2, components=1)


@pytest.fixture(scope="module")
def clean():
    return swinging()


@pytest.fixture(scope="module")
def accepted(clean, quick):
    """Posterior and diagnosis of a model that lacks nothing."""
    return fitted(pendulum, clean, quick)


@pytest.fixture(scope="module")
def found(accepted):
    return accepted[0]


def fitted(model, rollouts, quick):
    """Returns the posterior and the diagnosis of a fit."""
    posterior, result = fit(
        model, rollouts, backend=quick, rounds=1, num_simulations=200, progress=False
    )
    return posterior, result["diagnosis"]


def inside(posterior, name, value, mass=0.999):
    """Whether a value lies in the central interval of a mass."""
    draws = posterior.sample(2_000)[name]
    low, high = np.quantile(draws.numpy(), [0.5 * (1.0 - mass), 0.5 * (1.0 + mass)])
    return low < value < high


@pytest.mark.slow
def test_a_complete_model_is_accepted_at_the_true_parameters(accepted):
    found, diagnosis = accepted
    for name, value in TRUTH.items():
        assert inside(found, name, value)
        # The simulator's own steps of 20 ms would bias both by several per cent.
        assert found.sample(500)[name].mean() == pytest.approx(value, rel=0.01)
    assert diagnosis["decision"] == Decision.ACCEPT, diagnosis["reason"]
    assert found.preparation.are_steps_coarse
    assert "initial states estimated with their errors" in found.preparation.summary.sentence()


@pytest.mark.slow
def test_discovery_agrees_that_nothing_is_missing(clean, found):
    discovery = npdr.discover(pendulum, clean)
    assert discovery.verdict == "none", discovery.reason
    checks = found.checks()
    assert checks["model"]["p_value"] == discovery.alarm.p_value
    assert checks["priors"] == []
    assert prepared_as(discovery.to_dict()) == prepared_as({"preparation": summary(found)})


@pytest.mark.slow
def test_a_comparison_prepares_the_recording_like_a_fit(clean, found, quick):
    comparison = npdr.compare(
        pendulum, clean, backends={"quick": quick}, rounds=1, num_simulations=100, progress=False
    )
    assert comparison.to_dict()["preparation"] == summary(found)


def summary(posterior):
    return posterior.preparation.summary.to_dict()


def prepared_as(result):
    """Returns the preparation without the features, which discovery does not need."""
    return {name: value for name, value in result["preparation"].items() if name != "embedding"}


@pytest.mark.slow
def test_a_prior_that_excludes_the_truth_is_to_be_widened(clean, quick):
    _, diagnosis = fitted(too_short, clean, quick)
    assert diagnosis["decision"] == Decision.WIDEN
    assert "beyond the upper end of its prior, Uniform(0.3, 0.75)" in diagnosis["reason"]
    found = npdr.discover(too_short, clean)
    assert found.effects == []
    assert found.reason.startswith("length fits best at about")
    assert "with_wider_priors(revised_model, ['length'])" in found.source()


@pytest.mark.slow
def test_hidden_dry_friction_asks_for_another_model(quick):
    _, diagnosis = fitted(pendulum, swinging(friction=0.15), quick)
    assert diagnosis["decision"] == Decision.REVISE_MODEL
    assert diagnosis["model_p_value"] < 0.01


@pytest.mark.slow
def test_a_recording_that_is_too_short_for_the_model_check_does_not_blame_the_model(quick):
    _, result = fit(
        pendulum,
        swinging(friction=0.15, steps=100),
        backend=quick,
        num_simulations=200,
        options=npdr.DataOptions(segment_length=None),
        progress=False,
    )
    diagnosis = result["diagnosis"]
    assert diagnosis["decision"] != Decision.REVISE_MODEL
    assert diagnosis["model_p_value"] is None or np.isnan(diagnosis["model_p_value"])
    assert "was not tested" in diagnosis["reason"]


@pytest.mark.slow
def test_a_parameter_that_does_nothing_asks_for_another_rollout(clean, quick):
    posterior, diagnosis = fitted(with_idle, clean, quick)
    assert diagnosis["decision"] == Decision.NEW_ROLLOUT
    assert "nothing of idle" in diagnosis["reason"]
    # Where nothing more can be recorded the others are used all the same.
    last = npdr.diagnose(posterior.to_arviz(), rollouts_left=0)
    assert last.decision is Decision.ACCEPT
    assert last.reason.endswith("It does not determine idle.")


@pytest.mark.slow
def test_parameters_of_one_sum_ask_for_another_excitation(clean, quick):
    posterior, diagnosis = fitted(links, clean, quick)
    draws = posterior.sample(500)
    masses = torch.stack([draws[f"link{k}"] for k in range(8)])
    # The sum is known far better than its terms.
    assert masses.sum(0).std() < 0.1 * masses.std(1).mean()
    assert diagnosis["decision"] == Decision.OTHER_EXCITATION
    assert "only in combination with other parameters" in diagnosis["reason"]


@pytest.mark.slow
def test_declared_noise_that_is_too_small_asks_for_another_noise(clean, quick):
    model = npdr.with_noise(pendulum, {"angle": 0.001, "velocity": 0.005})
    posterior, diagnosis = fitted(model, clean, quick)
    assert diagnosis["decision"] == Decision.REVISE_MODEL
    assert "times as large as the declared noise" in diagnosis["reason"]
    assert posterior.checks()["model"]["misfit"] == pytest.approx(2.0, rel=0.1)


@pytest.mark.slow
def test_a_fit_spends_the_rounds_that_it_has_left(clean, quick, few_draws):
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


@pytest.mark.slow
def test_a_corrected_posterior_is_kept_on_disk(found, tmp_path):
    assert found.correction is not None
    found.save(tmp_path)
    loaded = npdr.Posterior.load(tmp_path, pendulum)
    for name, value in found.sample(50).items():
        assert torch.equal(loaded.sample(50)[name], value)
    assert loaded.checks() == found.checks()


@pytest.mark.slow
def test_nuts_agrees_with_a_learnt_posterior_on_uncertain_initial_states(quick):
    short = swinging(rollouts=1, steps=100)
    exact = npdr.infer(
        pendulum, short, backend=backend("nuts", chains=1, num_samples=50, warmup=30),
        progress=False,
    )  # fmt: skip
    other, _ = fitted(pendulum, short, quick)
    for name in TRUTH:
        one, two = exact.sample(50)[name], other.sample(2_000)[name]
        # Standard errors of both, and of 50 draws that are not independent.
        assert abs(float(one.mean() - two.mean())) < 0.6 * float(two.std())
        assert float(one.std() / two.std()) == pytest.approx(1.0, abs=0.4)
