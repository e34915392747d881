"""Weighted draws agree with integration on a grid, and their coordinates with their densities."""

from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch

from npdr_ppl.engines.ode.simulator import ODESimulator
from npdr_ppl.errors import DataError
from npdr_ppl.inference.base import Density
from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.estimator_check import check_estimator
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.importance_sampling import sample_posterior
from npdr_ppl.preparation.polynomials import Polynomial
from npdr_ppl.preparation.ridges import RidgeCoordinates, log_density_of
from npdr_ppl.preparation.sampling_coordinates import SamplingCoordinates
from tests.helpers.pendulum_recordings import product, swinging

TAIL = 1e-5
"""Factor of the part of a weight that has a Pareto tail. With a shape of 1.5, this part is about
4000 times as large at the farthest of 256 draws, which is too little to lower their effective
share."""


@pytest.fixture(scope="module")
def likelihood():
    return prepare(pendulum, swinging(rollouts=1, steps=200), DataOptions()).likelihood


@pytest.fixture(scope="module")
def ridge():
    return prepare(product, swinging(rollouts=1, steps=200), DataOptions()).likelihood


def on_a_grid(likelihood, wide=6.0, num=41):
    """Returns mean and covariance of the posterior by summation, ``(2,)`` and ``(2, 2)``."""
    eye = torch.eye(2, dtype=torch.float64)
    covariance = torch.linalg.inv(likelihood.information() + eye)
    root = torch.linalg.cholesky(covariance)
    axis = torch.linspace(-wide, wide, num, dtype=torch.float64)
    z = likelihood.fit.z + torch.cartesian_prod(axis, axis) @ root.mT
    weights = (likelihood.log_prob(z) + likelihood.segments.prior.log_prob(z)).softmax(0)
    mean = weights @ z
    away = z - mean
    return mean, (weights[:, None] * away).mT @ away


@pytest.mark.parametrize("weight", [1.0, 1e-4])
def test_weighted_draws_agree_with_a_grid(likelihood, weight):
    # With the smaller weight the recording says about as much as the prior does.
    likelihood = replace(likelihood, share=weight * likelihood.share)
    found = sample_posterior(likelihood, seed=0)
    assert found.is_reliable
    mean, covariance = on_a_grid(likelihood)
    sd = covariance.diagonal().sqrt()
    own = found.weights @ found.z
    spread = (found.weights @ (found.z - own).square()).sqrt()
    # Four standard errors at the effective sample size.
    error = 4.0 / found.effective**0.5
    assert bool(((own - mean).abs() < error * sd).all())
    assert bool(((spread / sd - 1.0).abs() < error).all())


def test_a_ridge_is_followed_to_the_ends_of_the_prior(ridge):
    found = sample_posterior(ridge, seed=0)
    assert found.is_reliable
    assert found.space.num_weak == 1
    values = ridge.segments.prior.to_parameters(found.z)
    mass = values["density"].double() * values["volume"].double()
    mean = found.weights @ mass
    assert float(((found.weights @ (mass - mean).square()) ** 0.5) / mean) < 0.01
    # A product of about 1.1 allows factors from 0.55 to 2: the whole of it is drawn.
    density = values["density"].double()
    likely = density[found.weights > found.weights.max() * 1e-3]
    assert float(likely.min()) < 0.65
    assert float(likely.max()) > 1.8


def many_idle(inputs):
    """A pendulum with parameters that do nothing, some with wide priors."""
    for number in range(8):
        pyro.sample(f"uniform_{number}", dist.Uniform(0.0, 1.0))
        pyro.sample(f"gain_{number}", dist.LogNormal(0.0, 2.0))
    return pendulum(inputs)


def test_parameters_that_do_nothing_cost_no_draws():
    prepared = prepare(many_idle, swinging(rollouts=1, steps=200), DataOptions())
    fit = prepared.likelihood.fit
    # A fit may end anywhere along them, as here at 1.5 standard deviations of the prior.
    away = torch.where(fit.z.abs() < 1e-3, 1.5, fit.z)
    likelihood = replace(prepared.likelihood, fit=replace(fit, z=away))
    found = sample_posterior(likelihood, seed=0)
    idle = RidgeCoordinates.of(likelihood, seed=0).space.is_reference
    assert int(idle.sum()) == 16 and found.is_reliable
    # The heavy tails of the first proposal leave half of the 512 draws at best.
    assert found.iterations == 1 and found.effective > 200
    mean, covariance = found.moments()
    assert float(mean[idle].abs().max()) < 0.3
    assert float((covariance.diagonal()[idle].sqrt() - 1.0).abs().max()) < 0.3


def known_gravity(inputs):
    """A pendulum with a parameter that does nothing and is known well in advance."""
    pyro.sample("gravity", dist.LogNormal(2.283, 0.001))
    return pendulum(inputs)


def test_the_volume_of_reference_coordinates_is_that_of_finite_differences():
    likelihood = prepare(many_idle, swinging(rollouts=1, steps=200), DataOptions()).likelihood
    prior = likelihood.segments.prior
    z = 0.5 * torch.ones(1, prior.num_parameters)
    mask = torch.tensor([site.name.startswith("uniform") for site in prior.sites])
    space = SamplingCoordinates.of(prior, mask)
    found = space.log_jacobian(z.double(), space.from_reference(z.double()))
    torch.testing.assert_close(found[0], space.slope(z[0].double()).log().sum(), rtol=0, atol=0.05)
    again = SamplingCoordinates.of_tensors(prior, space.tensors())
    assert torch.equal(again.from_reference(z), space.from_reference(z))
    with pytest.raises(DataError, match="earlier version"):
        SamplingCoordinates.of_tensors(prior, {})


def test_a_narrow_prior_of_a_parameter_that_does_nothing_is_kept():
    likelihood = prepare(known_gravity, swinging(rollouts=1, steps=200), DataOptions()).likelihood
    prior = likelihood.segments.prior
    space = SamplingCoordinates.of(prior, torch.tensor([s.name == "gravity" for s in prior.sites]))
    z = torch.zeros(1, prior.num_parameters, dtype=torch.float64)
    assert bool(space.log_jacobian(z, space.from_reference(z)).isfinite())
    mean, covariance = sample_posterior(likelihood, seed=0).moments()
    (place,) = space.is_reference.nonzero()[:, 0]
    assert abs(float(mean[place])) < 0.3
    assert float(covariance[place, place].sqrt()) == pytest.approx(1.0, abs=0.3)


def test_a_log_normal_parameter_is_sampled_by_its_logarithm():
    prepared = prepare(many_idle, swinging(rollouts=1, steps=200), DataOptions())
    prior = prepared.likelihood.segments.prior
    space = SamplingCoordinates.of(prior)
    names = [site.name for site in prior.sites]
    logs = {name for name, is_log in zip(names, space.is_logarithm, strict=True) if is_log}
    assert {name for name in names if name.startswith("gain")} <= logs
    assert not any(name.startswith("uniform") for name in logs)


def test_of_many_weak_coordinates_the_most_curved_are_traced(ridge):
    space = RidgeCoordinates.of(ridge, seed=0)
    straight = replace(space, bend=Polynomial.zero(2))
    density = log_density_of(ridge, straight)
    assert straight._most_curved(density, 2).tolist() == [True, False]


def test_coordinates_along_a_ridge_and_back(ridge):
    space = RidgeCoordinates.of(ridge, seed=0)
    torch.manual_seed(0)
    z = ridge.fit.z + 0.1 * torch.randn(20, 3, dtype=torch.float64)
    w = space.from_reference(z)
    back, inside = space.to_reference(w)
    assert bool(inside.all())
    torch.testing.assert_close(back, z, rtol=0, atol=1e-4)  # the sites are in single precision
    again = RidgeCoordinates.of_tensors(ridge.segments.prior, space.tensors())
    assert torch.equal(again.from_reference(z), w)


def test_the_volume_of_the_coordinates_is_that_of_finite_differences(ridge):
    space = RidgeCoordinates.of(ridge, seed=0)
    z = ridge.fit.z
    width = 1e-2
    steps = width * torch.eye(3, dtype=torch.float64)
    columns = (space.from_reference(z + steps) - space.from_reference(z - steps)) / (2 * width)
    expected = torch.linalg.slogdet(columns).logabsdet
    torch.testing.assert_close(space.log_jacobian(z[None])[0], expected, rtol=0, atol=0.01)


def test_a_posterior_that_is_right_is_kept_and_one_that_is_off_is_corrected(likelihood):
    mean, covariance = on_a_grid(likelihood)
    one = torch.ones(1, dtype=torch.float64)
    right = GaussianMixture.from_moments(one, mean[None], covariance[None])
    check, correction = check_estimator([right], likelihood, seed=0, corrects=True)
    assert correction is None
    assert check.is_reliable
    assert check.learnt_effective_share > 0.9
    sd = covariance.diagonal().sqrt()
    off = GaussianMixture.from_moments(one, (mean + 8.0 * sd)[None], covariance[None])
    check, correction = check_estimator([off], likelihood, seed=0, corrects=True)
    assert check.learnt_pareto_k > 0.7 or check.learnt_effective_share < 0.9
    assert correction is not None
    assert check.is_reliable
    torch.manual_seed(0)
    draws = torch.cat([density.sample(1_000).double() for density in correction.densities])
    assert bool(((draws.mean(0) - mean).abs() < 0.3 * sd).all())
    # Four standard errors of the width of 512 kernels, about 3 % each.
    assert bool(((draws.std(0) / sd - 1.0).abs() < 0.15).all())
    # A few draws far away are enough to spoil leave-one-out weights.
    far = GaussianMixture.from_moments(
        torch.tensor([0.95, 0.05]).double(),
        mean.expand(2, -1),
        torch.stack((covariance, 100.0 * covariance)),
    )
    assert check_estimator([far], likelihood, seed=0, corrects=True)[1] is not None
    # Left as it is where correcting is not wanted, and told.
    check, correction = check_estimator([off], likelihood, seed=0, corrects=False)
    assert correction is None
    assert not check.is_reliable


def test_a_posterior_that_is_slightly_off_agrees_where_it_is_not_corrected(likelihood):
    mean, covariance = on_a_grid(likelihood)
    sd = covariance.diagonal().sqrt()

    def shifted(deviations):
        """Returns the check of a normal density, whose share is about exp(−deviations²)."""
        at = mean + sd * torch.tensor([0.0, deviations]).double()
        density = GaussianMixture.from_moments(
            torch.ones(1, dtype=torch.float64), at[None], 1.05 * covariance[None]
        )
        return check_estimator([density], likelihood, seed=0, corrects=False)[0]

    near, far = shifted(0.2), shifted(1.0)
    assert 0.8 < near.learnt_effective_share < 0.99 and near.is_reliable
    assert far.learnt_effective_share < 0.8 and not far.is_reliable


class Weighted(Density):
    """Draws of the posterior, and a density in proportion to the posterior's over a weight.

    Attributes:
        shape: The weights have a Pareto tail of this shape; 0 for equal weights.
    """

    def __init__(self, likelihood, shape=0.0):
        self.likelihood, self.shape = likelihood, shape
        mean, covariance = on_a_grid(likelihood)
        self.normal = torch.distributions.MultivariateNormal(mean, covariance)

    def sample(self, num_samples):
        return self.normal.sample((num_samples,))

    def log_prob(self, z):
        # In two dimensions, the probability of a greater distance: uniform between 0 and 1.
        away = torch.linalg.solve_triangular(
            self.normal.scale_tril, (z - self.normal.mean).mT, upper=False
        )
        beyond = (-0.5 * away.square().sum(0)).exp()
        weight = 1.0 + TAIL * (beyond**-self.shape - 1.0)
        prior = self.likelihood.segments.prior
        return self.likelihood.log_prob(z) + prior.log_prob(z) - weight.log()


def test_draws_of_the_posterior_itself_need_no_correction(likelihood):
    check, correction = check_estimator([Weighted(likelihood)], likelihood, seed=0, corrects=True)
    assert correction is None and check.is_reliable
    assert check.learnt_effective_share == pytest.approx(1.0)


@pytest.mark.parametrize("shape", [0.2, 1.5])
def test_weights_with_a_heavy_tail_are_refused_even_if_they_are_nearly_equal(likelihood, shape):
    learnt = [Weighted(likelihood, shape)]
    check, correction = check_estimator(learnt, likelihood, seed=0, corrects=True)
    # By their effective share alone, both would be kept.
    assert check.learnt_effective_share > 0.99
    # The tail has 48 draws; the standard error of its shape is (1 + k) / √48.
    assert check.learnt_pareto_k == pytest.approx(shape, abs=3.0 * (1.0 + shape) / 48**0.5)
    is_off = shape > 0.7
    assert check.is_corrected == is_off
    assert (correction is not None) == is_off
    check, _ = check_estimator(learnt, likelihood, seed=0, corrects=False)
    assert check.is_reliable == (not is_off)


def test_the_information_is_the_curvature_of_the_likelihood(likelihood):
    likelihood = replace(likelihood, share=0.3)
    z, size = likelihood.fit.z, 0.3 / likelihood.information().diagonal().sqrt()
    steps = torch.diag(size)
    points = torch.cat([z[None], z + steps, z - steps])
    values = likelihood.log_prob(points)
    curvature = (2.0 * values[0] - values[1:3] - values[3:]) / size.square()
    torch.testing.assert_close(likelihood.information().diagonal(), curvature, rtol=0.1, atol=0.0)


def test_the_likelihood_of_other_starts_is_that_of_one_normal_distribution(
    likelihood, monkeypatch
):
    """With C = 1 + G Gᵀ written out, as the closed form would have it."""
    monkeypatch.setattr(ODESimulator, "with_coarser_steps", lambda self, *_, **__: None)
    likelihood = replace(likelihood, share=0.3)
    z = likelihood.fit.z[None] + torch.tensor([[0.0, 0.0], [0.01, -0.02]], dtype=torch.float64)
    now, segments = likelihood.linearisation, likelihood.segments
    offsets = likelihood.fit.offsets[None].expand(2, -1, -1)
    residual = segments.residuals(z, offsets, likelihood.fit.scale)
    residual = residual + (now.by_starts @ likelihood.fit.offsets[..., None])[..., 0]
    assert bool(segments.inputs.mask.all())
    size = residual.shape[-1]
    covariance = torch.eye(size, dtype=torch.float64) + now.by_starts @ now.by_starts.mT
    normal = torch.distributions.MultivariateNormal(
        torch.zeros(size, dtype=torch.float64), likelihood.variance * covariance
    )
    scale = segments.inputs.num_steps * likelihood.fit.scale.log().sum()
    expected = likelihood.share * (normal.log_prob(residual) - scale)
    torch.testing.assert_close(likelihood.by_segment(z), expected)
