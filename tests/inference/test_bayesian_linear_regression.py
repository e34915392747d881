"""Counting and leaving out implausible draws, and the density of the others."""

import logging
import math
from dataclasses import replace

import pytest
import torch
from scipy import integrate, stats

from npdr_ppl.errors import BackendError, DataError
from npdr_ppl.inference.base import Problem
from npdr_ppl.inference.bayesian_linear_regression import NUM_DRAWS
from npdr_ppl.inference.parts.samplers.conjugate import linear_posterior
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.linear_regression_problem import LinearRegression
from npdr_ppl.randomness import seeded

NAME = "bayesian-linear-regression"


def make_regression(to_reference, from_reference, determined, nominal=(0.0, 0.0), offset=0.5):
    generator = torch.Generator().manual_seed(0)
    regressors = torch.randn(9, 1, generator=generator, dtype=torch.float64)
    noise = torch.randn(9, generator=generator, dtype=torch.float64)
    return LinearRegression(
        regressors=regressors,
        targets=offset * regressors[:, 0] + noise,
        names=("slope",),
        prior_mean=torch.zeros(1, dtype=torch.float64),
        prior_covariance=4.0 * torch.eye(1, dtype=torch.float64),
        determined=torch.tensor(determined),
        nominal=torch.tensor(nominal, dtype=torch.float64)[: len(determined)],
        to_reference=to_reference,
        from_reference=from_reference,
    )


def make_problem(regression):
    d = len(regression.determined)
    normal = torch.distributions.Normal(0.0, 1.0)
    return Problem(
        num_parameters=d,
        observation=torch.zeros(1),
        sample_prior=lambda n: torch.randn(n, d),
        log_prior=lambda z: normal.log_prob(z).sum(-1),
        regression=lambda smoothing: regression,
    )


def positive():
    """One coordinate z = β, plausible where it is positive."""
    return make_regression(
        lambda base, z: (base.abs(), base[:, 0] > 0.0),
        lambda z: torch.where(z > 0.0, z, torch.nan),
        [True],
    )


def fit(regression, **options):
    method, problem = backend(NAME, **options), make_problem(regression)
    with seeded(0, "fit"):
        z = method.ask(problem, method.init(problem), 100)
        assert z.shape == (0, len(regression.determined))
        state, info = method.tell(problem, method.init(problem), z, torch.empty(0, 1))
    (density,) = method.densities(problem, state)
    return density, info, method


def own_posterior(regression):
    posterior = linear_posterior(
        regression.regressors,
        regression.targets,
        regression.prior_mean,
        regression.prior_covariance,
    )
    return stats.t(9, float(posterior.mean), float(posterior.factor))


def test_implausible_draws_are_counted(caplog):
    regression = positive()
    with caplog.at_level(logging.WARNING):
        _, info, _ = fit(regression)
    share = own_posterior(regression).cdf(0.0)
    assert 0.02 < share < 0.5, "the case has both kinds"
    error = (share * (1.0 - share) / NUM_DRAWS) ** 0.5
    assert abs(info.losses["implausible_share"] - share) < 4.5 * error
    assert info.losses["implausible"] == round(info.losses["implausible_share"] * NUM_DRAWS)
    assert f"{info.losses['implausible']} of {NUM_DRAWS} draws" in caplog.text
    assert info.num_simulations == 0


def test_only_plausible_points_are_drawn_and_their_density_is_the_truncated_one():
    regression = positive()
    density, info, _ = fit(regression)
    with seeded(1):
        z = density.sample(4_000)
    assert z.shape == (4_000, 1)
    assert (z > 0.0).all()
    expected = own_posterior(regression)
    above = expected.sf(0.0)
    # Kolmogorov's bound for a false alarm in 10 000.
    statistic = stats.kstest(z[:, 0], lambda v: (expected.cdf(v) - expected.cdf(0)) / above)
    assert statistic.pvalue > 1e-4
    points = torch.tensor([[0.2], [0.9], [-0.1]], dtype=torch.float64)
    log_prob = density.log_prob(points)
    wanted = expected.logpdf(points[:, 0]) - math.log(1.0 - info.losses["implausible_share"])
    torch.testing.assert_close(log_prob[:2], torch.as_tensor(wanted[:2]))
    assert log_prob[2] == -torch.inf


def gained():
    """β = z₀³ exp(z₁): curved in what it determines, scaled by what it does not."""

    def to_reference(base, z):
        cube = base[:, 0] / z[:, 1].exp()
        first = cube.sign() * cube.abs() ** (1.0 / 3.0)
        return torch.stack((first, z[:, 1]), -1), torch.ones(len(base), dtype=torch.bool)

    return make_regression(to_reference, lambda z: z[:, :1] ** 3 * z[:, 1:].exp(), [True, False])


def test_free_coordinates_keep_their_prior_and_the_density_has_the_jacobian():
    regression = gained()
    density, info, _ = fit(regression)
    assert info.losses["implausible"] == 0
    with seeded(2):
        z = density.sample(20_000)
    assert stats.kstest(z[:, 1], "norm").pvalue > 1e-4
    base = regression.from_reference(z)[:, 0]
    assert stats.kstest(base, own_posterior(regression).cdf).pvalue > 1e-4

    def q(first, second):
        return float(density.log_prob(torch.tensor([[first, second]])).exp())

    # The mass of a box, by quadrature of the density and by counting draws.
    box, _ = integrate.dblquad(lambda b, a: q(a, b), 0.4, 0.9, -0.5, 0.8, epsabs=1e-4)
    inside = (z[:, 0] > 0.4) & (z[:, 0] < 0.9) & (z[:, 1] > -0.5) & (z[:, 1] < 0.8)
    assert abs(inside.double().mean() - box) < 4.5 * (box * (1 - box) / len(z)) ** 0.5 + 1e-3


def test_free_coordinates_can_be_held_at_nominal():
    held = gained()
    held = make_regression(
        held.to_reference, held.from_reference, [True, False], nominal=(math.nan, 0.7)
    )
    density, _, _ = fit(held, undetermined="nominal")
    with seeded(3):
        z = density.sample(100)
    assert (z[:, 1] == 0.7).all()

    def q(first):
        return float(density.log_prob(torch.tensor([[first, 0.7]])).exp())

    assert integrate.quad(q, -4.0, 4.0, points=[0.0])[0] == pytest.approx(1.0, abs=1e-3)
    unreachable = make_regression(
        held.to_reference, held.from_reference, [True, False], nominal=(0.0, math.nan)
    )
    with pytest.raises(BackendError, match="nominal value lies off"):
        fit(unreachable, undetermined="nominal")


def test_nothing_plausible_is_an_error_with_the_base_parameters():
    nothing = make_regression(
        lambda base, z: (base, torch.zeros(len(base), dtype=torch.bool)), lambda z: z, [True]
    )
    with pytest.raises(BackendError, match="None of 20000 draws.*slope = 0.* ± .*widen"):
        fit(nothing)


def test_bad_options_and_problems_are_refused():
    with pytest.raises(BackendError, match="undetermined must be"):
        backend(NAME, undetermined="sometimes")
    with pytest.raises(DataError, match="position_cutoff must be a positive frequency"):
        backend(NAME, position_cutoff=-1.0)
    problem = make_problem(positive())
    with pytest.raises(BackendError, match="declares inverse_dynamics"):
        backend(NAME).init(replace(problem, regression=None))
    with pytest.raises(BackendError, match="is of backend 'snpe-c'"):
        backend(NAME).restore(problem, {}, {"backend": "snpe-c", "round": 0})
    with pytest.raises(BackendError, match="prior only if every prior has quantiles"):
        regression = gained()
        curved = replace(make_problem(regression), is_prior_standard_normal=False)
        method = backend(NAME)
        method.tell(curved, method.init(curved), torch.empty(0, 2), torch.empty(0, 1))
