"""Polynomials stand for a recording's residuals, and draws under them for the posterior."""

from dataclasses import replace

import pytest
import torch

from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.residual_surrogate import ResidualSurrogate
from npdr_ppl.preparation.ridges import RidgeCoordinates
from npdr_ppl.preparation.sampling_settings import RESIDUAL_SURROGATE
from npdr_ppl.preparation.segment_likelihood import SegmentLikelihood
from npdr_ppl.preparation.surrogate_sampling import surrogate_draws
from tests.helpers.pendulum_recordings import links, product, swinging


def residuals(w):
    """Residuals of a thin bent ridge: five measurements of w₁ − 0.3 w₀², and one of w₀."""
    across = 4.0 * (w[:, 1] - 0.3 * w[:, 0].square())
    around = across[:, None] * torch.tensor([1.0, -1.0, 0.5, 2.0, 0.1]).double()
    return torch.cat((around, w[:, :1]), -1)


def fitted(number):
    generator = torch.Generator().manual_seed(0)
    w = 1.5 * torch.randn(number, 2, generator=generator, dtype=torch.float64)
    q = residuals(w)
    zero, one = torch.zeros(2).double(), torch.ones(2).double()
    return ResidualSurrogate.of(w, q @ q.mT, zero, one)


def test_a_bent_ridge_is_known_from_few_points():
    surrogate = fitted(60)
    w = torch.tensor([[0.0, 0.0], [2.0, 1.2], [-3.0, 2.7], [1.0, -1.0], [2.5, 1.0]]).double()
    exact = -0.5 * residuals(w).square().sum(-1)
    assert surrogate(w, 10.0) == pytest.approx(exact, rel=1e-6, abs=1e-6)


def test_polynomials_are_not_trusted_far_from_the_points_of_their_fit():
    near, far = torch.tensor([[0.5, 0.1]]).double(), torch.tensor([[20.0, 120.0]]).double()
    surrogate = fitted(60)
    assert surrogate(near).isfinite() and surrogate(far) == -torch.inf
    assert surrogate(far, 1e12).isfinite()


@pytest.mark.parametrize("size", [1e6, 1e18])
def test_a_wild_residual_does_not_spoil_the_others(size):
    generator = torch.Generator().manual_seed(0)
    w = torch.randn(12, 2, generator=generator, dtype=torch.float64)
    q = residuals(w)
    q[3] *= size
    zero, one = torch.zeros(2).double(), torch.ones(2).double()
    wild = ResidualSurrogate.of(w, q @ q.mT, zero, one)
    others = torch.arange(12) != 3
    # A point of that weight may move polynomials by about its own standard deviation.
    exact = -0.5 * residuals(w[others]).square().sum(-1)
    assert wild(w[others], 1e12) == pytest.approx(exact, abs=1.0)


def test_too_few_points_have_no_polynomials():
    assert fitted(2) is None


@pytest.fixture(scope="module")
def ridge():
    return prepare(product, swinging(rollouts=1, steps=200), DataOptions()).likelihood


def drawn(likelihood, given=()):
    """Draws with polynomials in coordinates in which the ridge is straight."""
    space = RidgeCoordinates.of(likelihood, seed=0)
    return surrogate_draws(likelihood, space, given, seed=0)


def test_the_squares_of_whitened_residuals_are_the_likelihood(ridge):
    torch.manual_seed(0)
    z = ridge.fit.z + 0.1 * torch.randn(5, 3, dtype=torch.float64)
    own, squares = ridge.log_prob(z), ridge.whitened(z).square().sum(-1)
    assert own - own[0] == pytest.approx(-0.5 * (squares - squares[0]), rel=1e-6, abs=1e-6)


def test_few_simulations_suffice(ridge, monkeypatch):
    asked = []
    whitened = SegmentLikelihood.whitened

    def counted(self, z):
        asked.append(len(z))
        return whitened(self, z)

    monkeypatch.setattr(SegmentLikelihood, "whitened", counted)
    found = drawn(ridge)
    assert found is not None and found.has_enough
    assert sum(asked) < 700
    again = drawn(ridge)
    assert torch.equal(found.z, again.z)


@pytest.mark.slow
def test_draws_are_as_wide_as_a_ridge_of_many_dimensions():
    likelihood = prepare(links, swinging(), DataOptions()).likelihood
    found = drawn(likelihood)
    assert found is not None and found.is_reliable
    # Eight normal masses of which only the sum is known. About 200 effective draws tell each of
    # the deviations up to 5 %, and the mean of eight better.
    spread = found.moments()[1].diagonal()[:8].sqrt()
    assert spread.mean() == pytest.approx((7.0 / 8.0) ** 0.5, rel=0.1)


def test_draws_do_not_leave_out_a_mode(ridge):
    found = drawn(ridge)
    mean, covariance = found.moments()
    one = torch.ones(1, dtype=torch.float64)
    same = GaussianMixture.from_moments(one, mean[None], covariance[None])
    assert drawn(ridge, [same]) is not None
    # A copy of the closest fit, far from it along the most certain direction.
    way = torch.linalg.eigh(covariance).eigenvectors[:, 0]
    other = GaussianMixture.from_moments(
        one, (ridge.fit.z + 3.0 * way)[None], 1e-6 * covariance[None]
    )

    class TwoModes(SegmentLikelihood):
        def whitened(self, z):
            beside = z - 3.0 * way
            is_other = (z - ridge.fit.z) @ way > 1.5
            return super().whitened(torch.where(is_other[:, None], beside, z))

    fields = {f: getattr(ridge, f) for f in ridge.__dataclass_fields__}
    found = drawn(TwoModes(**fields), [other])
    is_other = None if found is None else (found.z - ridge.fit.z) @ way > 1.5
    assert is_other is None or (bool(is_other.any()) and not bool(is_other.all()))


def test_there_are_none_if_they_would_take_too_much_memory(ridge, monkeypatch):
    settings = replace(RESIDUAL_SURROGATE, most_bytes=1_000)
    monkeypatch.setattr("npdr_ppl.preparation.surrogate_sampling.RESIDUAL_SURROGATE", settings)
    assert drawn(ridge) is None
