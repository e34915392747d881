"""The functions on ArviZ objects, against closed forms."""

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

import npdr_ppl
import npdr_ppl as npdr
from npdr_ppl.arviz_module import (
    compare,
    ess,
    ess_of_mean,
    from_dict,
    from_netcdf,
    group,
    group_names,
    hdi,
    loo,
    pareto_smoothed,
    rhat,
    to_netcdf,
)
from npdr_ppl.errors import DataError

CHAINS, DRAWS = 4, 2_000
OBSERVED = np.array([-1.2, 0.1, 0.3, 0.9, 1.4, 2.2])


def normal_mean(prior_mean=0.0, seed=0):
    """The exact posterior of a normal mean, x_i ~ N(mu, 1) and mu ~ N(prior_mean, 1)."""
    n = len(OBSERVED)
    rng = np.random.default_rng(seed)
    centre, sd = (prior_mean + OBSERVED.sum()) / (n + 1), (n + 1) ** -0.5
    mu = centre + sd * rng.standard_normal((CHAINS, DRAWS))
    return from_dict(
        {
            "posterior": {"mu": mu, "pair": np.stack((mu, 2 * mu), -1)},
            "prior": {"mu": prior_mean + rng.standard_normal((1, 100))},
            "observed_data": {"x": OBSERVED},
            "log_likelihood": {"x": norm.logpdf(OBSERVED, mu[..., None])},
        },
        coords={"axis": ["u", "v"]},
        dims={"pair": ["axis"], "x": ["reading"]},
        attrs={"backend": "exact"},
        variable_attrs={"posterior": {"mu": {"units": "kg"}}},
    )


def exact_elpd(prior_mean=0.0):
    """The sum of log p(x_i | all others), in closed form."""
    others = (prior_mean + OBSERVED.sum() - OBSERVED) / len(OBSERVED)
    return norm.logpdf(OBSERVED, others, np.sqrt(1 + 1 / len(OBSERVED)))


def test_groups_dimensions_and_attributes():
    data = normal_mean()
    assert set(group_names(data)) == {"posterior", "prior", "observed_data", "log_likelihood"}
    posterior = group(data, "posterior")
    assert posterior["pair"].dims == ("chain", "draw", "axis")
    assert list(posterior["axis"].values) == ["u", "v"]
    assert posterior["mu"].attrs["units"] == "kg"
    assert group(data, "observed_data")["x"].dims == ("reading",)
    assert group(data, "log_likelihood")["x"].shape == (CHAINS, DRAWS, len(OBSERVED))
    assert data.attrs["backend"] == "exact"
    with pytest.raises(DataError, match="no group 'predictions'"):
        group(data, "predictions")
    other = from_dict({"prior_sbc": {"mu": np.zeros((1, 5))}})
    assert group(other, "prior_sbc")["mu"].shape == (1, 5)


def test_intervals_are_the_shortest():
    intervals = hdi(normal_mean(), 0.94)
    low, high = (float(intervals["mu"].sel(ci_bound=b)) for b in ("lower", "upper"))
    sd, centre = len(OBSERVED[:-1]) + 2, OBSERVED.sum() / 7
    sd = sd**-0.5
    # A shortest interval's ends wander more than quantiles, at the rate n^(-1/3).
    tolerance = 2 * sd * (CHAINS * DRAWS) ** (-1 / 3)
    assert abs(low - norm.ppf(0.03, centre, sd)) < tolerance
    assert abs(high - norm.ppf(0.97, centre, sd)) < tolerance
    assert intervals["pair"].shape == (2, 2)


def test_convergence_figures():
    data = normal_mean()
    assert abs(float(rhat(data)["mu"]) - 1) < 0.01
    assert abs(float(ess(data)["mu"]) / (CHAINS * DRAWS) - 1) < 0.15
    assert rhat(data)["pair"].shape == (2,)
    chains = np.random.default_rng(1).standard_normal((4, 500))
    assert float(rhat(from_dict({"posterior": {"a": chains + np.arange(4)[:, None]}}))["a"]) > 1.3
    assert np.isnan(rhat(from_dict({"posterior": {"a": chains[:1]}}))["a"])
    # An AR(1) process with coefficient rho has n (1 - rho) / (1 + rho) effective draws.
    correlated = np.zeros((4, 5_000))
    noise = np.random.default_rng(2).standard_normal(correlated.shape)
    for t in range(1, correlated.shape[1]):
        correlated[:, t] = 0.8 * correlated[:, t - 1] + noise[:, t]
    expected = correlated.size * 0.2 / 1.8
    assert abs(ess_of_mean(correlated) / expected - 1) < 0.2


def test_equal_weights_have_no_tail_and_one_large_weight_has_a_heavy_one():
    log_weights, k = pareto_smoothed(np.full(256, -1234.5))
    assert k == 0.0 and log_weights == pytest.approx(np.full(256, -np.log(256)))
    # Normal log weights with a standard deviation of 0.1, as of a posterior that is nearly right.
    normal = np.random.default_rng(0).standard_normal(256)
    assert pareto_smoothed(0.1 * normal)[1] < 0.5 < pareto_smoothed(5.0 * normal)[1]
    assert pareto_smoothed(np.where(np.arange(256) < 20, 0.0, -np.inf))[1] == np.inf


def test_draws_without_log_likelihoods_have_no_say_in_cross_validation():
    data = normal_mean()
    few = {name: group(data, name) for name in ("posterior", "log_likelihood")}
    likelihood = few["log_likelihood"].isel(draw=slice(0, 50))["x"].values
    mu = few["posterior"]["mu"].values
    some = from_dict({"posterior": {"mu": mu[:, :50]}, "log_likelihood": {"x": likelihood}})
    every = from_dict({"posterior": {"mu": mu}, "log_likelihood": {"x": likelihood}})
    assert loo(every).pareto_k == pytest.approx(loo(some).pareto_k)
    table, other = compare({"a": every, "b": every}), compare({"a": some, "b": some})
    assert table["elpd"].to_numpy() == pytest.approx(other["elpd"].to_numpy())


def test_cross_validation_has_its_closed_form():
    found = loo(normal_mean())
    exact = exact_elpd()
    # Monte-Carlo error of a log mean over 8000 draws with weights of order one: some 1e-2.
    assert found.elpd_i == pytest.approx(exact, abs=0.05)
    assert found.elpd == pytest.approx(exact.sum(), abs=0.1)
    assert found.se == pytest.approx((len(exact) * exact.var(ddof=1)) ** 0.5, rel=0.05)
    assert 0.3 < found.p < 1.5
    assert found.pareto_k.shape == OBSERVED.shape and found.pareto_k.max() < 0.7


def test_a_single_observation_has_no_standard_error():
    mu = np.random.default_rng(4).standard_normal((4, 500)) / 2
    likelihood = norm.logpdf(0.3, mu)[..., None]
    data = from_dict({"posterior": {"mu": mu}, "log_likelihood": {"x": likelihood}})
    assert np.isfinite(loo(data).elpd) and np.isnan(loo(data).se)
    assert np.isnan(compare({"one": data, "other": data})["se"]).all()


def test_comparison_ranks_by_closed_form():
    models = {"far": normal_mean(prior_mean=-3.0), "near": normal_mean()}
    table = compare(models)
    assert list(table.index) == ["near", "far"] and list(table["rank"]) == [0, 1]
    difference = exact_elpd(-3.0).sum() - exact_elpd().sum()
    assert table.loc["far", "elpd_diff"] == pytest.approx(difference, abs=0.15)
    assert table.loc["near", "elpd_diff"] == 0
    assert table["weight"].sum() == pytest.approx(1)
    assert table.loc["near", "elpd"] == pytest.approx(loo(models["near"]).elpd)
    assert table.loc["near", "se"] == pytest.approx(loo(models["near"]).se)
    pointwise = exact_elpd() - exact_elpd(-3.0)
    expected = (len(pointwise) * pointwise.var(ddof=1)) ** 0.5
    assert table.loc["far", "dse"] == pytest.approx(expected, rel=0.1)
    assert list(table.columns) == [
        "rank", "elpd", "p", "elpd_diff", "weight", "se", "dse", "warning",
    ]  # fmt: skip
    # With an observation far out, a draw or two carry all the weight.
    assert not table["warning"].any()
    outlier = np.random.default_rng(3).standard_normal((4, 500))
    log_likelihood = norm.logpdf(np.array([0.0, 9.0]), outlier[..., None])
    data = from_dict({"posterior": {"mu": outlier}, "log_likelihood": {"x": log_likelihood}})
    assert loo(data).pareto_k.max() > 0.7
    assert compare({"one": data, "other": data})["warning"].all()


@pytest.mark.slow
def test_files_come_back(tmp_path):
    data = normal_mean()
    path = tmp_path / "posterior.nc"
    to_netcdf(data, path)
    loaded = from_netcdf(path)
    path.unlink()
    assert set(group_names(loaded)) == set(group_names(data))
    for name in group_names(data):
        for variable, values in group(data, name).data_vars.items():
            assert np.array_equal(group(loaded, name)[variable].values, values.values)
    assert group(loaded, "posterior")["mu"].attrs["units"] == "kg"
    assert loaded.attrs["backend"] == "exact"


@pytest.mark.slow
def test_a_posterior_is_exported_completely(noisy_pendulum, recording, quick, tmp_path):
    posterior = npdr.infer(
        noisy_pendulum, recording, backend=quick, num_simulations=60,
        options=npdr.DataOptions(segment_length=50, initial_state="estimated", embedding="all/10"),
        progress=False,
    )  # fmt: skip
    data = posterior.to_arviz(120)
    assert set(group_names(data)) == {
        "prior", "prior_predictive", "posterior", "posterior_predictive", "observed_data",
        "constant_data", "log_likelihood", "sample_stats",
    }  # fmt: skip
    segments, steps, channels = 4, 50, 2
    shapes = {
        ("prior", "mass"): (1, 120),
        ("prior_predictive", "trajectory"): (1, 50, segments, steps, channels),
        ("posterior", "length"): (2, 120),
        ("posterior_predictive", "trajectory"): (2, 100, segments, steps, channels),
        ("observed_data", "trajectory"): (segments, steps, channels),
        ("constant_data", "trajectory_actions"): (segments, steps, 1),
        ("log_likelihood", "trajectory"): (2, 100, segments),
        ("sample_stats", "lp"): (2, 120),
    }
    for (name, variable), shape in shapes.items():
        assert group(data, name)[variable].shape == shape, (name, variable)
    units = {n: group(data, "posterior")[n].attrs["units"] for n in ("mass", "length")}
    assert units == {"mass": "kg", "length": "m"}
    assert list(group(data, "prior_predictive")["trajectory_channel"].values) == [
        "angle", "velocity",
    ]  # fmt: skip
    assert "declared noise" in group(data, "log_likelihood")["trajectory"].attrs["error_model"]
    # The prior predictive belongs to the prior's first draws.
    draws = group(data, "prior")
    few = {n: draws[n].values[0, :3] for n in ("mass", "length")}
    noisy = group(data, "prior_predictive")["trajectory"].values[0, :3]
    import torch

    again = posterior.prior.execute_at({n: torch.as_tensor(v) for n, v in few.items()})
    residual = noisy - again["trajectory"].numpy()
    # Two independent draws of the noise, 0.05 and 0.2, whatever the parameters.
    assert residual.std((0, 1, 2)) == pytest.approx(np.sqrt(2) * np.array([0.05, 0.2]), rel=0.15)
    to_netcdf(data, tmp_path / "posterior.nc")
    assert np.isfinite(loo(from_netcdf(tmp_path / "posterior.nc")).elpd)


@pytest.mark.slow
def test_no_other_module_imports_arviz():
    root = Path(npdr_ppl.__file__).parent
    offenders = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0].startswith("arviz") for name in names):
                offenders.add(path.name)
    assert offenders == {"arviz_module.py"}


def test_leave_one_out_of_weights_hundreds_of_orders_apart_is_unreliable():
    # The tail begins 6e-309 above the smallest normal number; ArviZ alone returns 1/3.
    log_weights = np.r_[-np.linspace(760, 720, 20), -708.16, -698.0, -307.0, -256.0, 0.0]
    likelihood = np.stack((-log_weights, np.linspace(-1.0, 1.0, 25)), axis=-1)[None]
    draws = {"a": np.linspace(-1.0, 1.0, 25)[None]}
    data = from_dict({"posterior": draws, "log_likelihood": {"x": likelihood}})
    k = loo(data).pareto_k
    assert k[0] == np.inf and k[1] < 1.0
