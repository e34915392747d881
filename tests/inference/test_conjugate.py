"""The conjugate posterior against integration over the noise, one normal posterior at a time."""

import pytest
import torch

from npdr_ppl.errors import BackendError, ShapeError
from npdr_ppl.inference.parts.samplers.conjugate import StudentT, linear_posterior, row_noise
from npdr_ppl.randomness import seeded


@pytest.fixture
def problem():
    generator = torch.Generator().manual_seed(3)
    regressors = torch.randn(12, 2, generator=generator, dtype=torch.float64)
    targets = regressors @ torch.tensor([1.0, -0.5], dtype=torch.float64)
    targets = targets + 0.3 * torch.randn(12, generator=generator, dtype=torch.float64)
    mean = torch.tensor([0.2, 0.1], dtype=torch.float64)
    covariance = torch.tensor([[2.0, 0.3], [0.3, 0.5]], dtype=torch.float64)
    return regressors, targets, mean, covariance


def integrated(problem, points):
    """Returns mean, covariance and density of β by integrating log σ² over a fine grid.

    p(β | t) = ∫ N(β | m, σ² Λ⁻¹) p(σ² | t) dσ² with p(σ² | t) ∝ N(t | A m₀, σ² (I + A V₀ Aᵀ))/σ².
    """
    a, t, m0, v0 = problem
    log_variance = torch.linspace(-8.0, 6.0, 8001, dtype=torch.float64)
    marginal = torch.eye(len(t), dtype=torch.float64) + a @ v0 @ a.T
    log_weight = torch.stack(
        [
            torch.distributions.MultivariateNormal(a @ m0, s.exp() * marginal).log_prob(t)
            for s in log_variance
        ]
    )
    # dσ²/σ² = d log σ², so that the prior is uniform on this grid.
    weight = (log_weight - log_weight.logsumexp(0)).exp()
    precision = v0.inverse() + a.T @ a
    mean = torch.linalg.solve(precision, torch.linalg.solve(v0, m0) + a.T @ t)
    covariance = (weight * log_variance.exp()).sum() * precision.inverse()
    density = torch.stack(
        [
            torch.distributions.MultivariateNormal(mean, s.exp() * precision.inverse())
            .log_prob(points)
            .exp()
            for s in log_variance
        ]
    )
    return mean, covariance, (weight[:, None] * density).sum(0)


@pytest.mark.slow
def test_inferred_noise_agrees_with_integration(problem):
    points = torch.tensor([[1.0, -0.5], [0.8, -0.3], [1.2, 0.5]], dtype=torch.float64)
    mean, covariance, density = integrated(problem, points)
    posterior = linear_posterior(*problem)
    assert posterior.degrees == 12
    torch.testing.assert_close(posterior.mean, mean)
    own = posterior.factor @ posterior.factor.T * 12.0 / 10.0
    torch.testing.assert_close(own, covariance, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(posterior.standard_deviations(), own.diagonal().sqrt())
    torch.testing.assert_close(posterior.log_prob(points).exp(), density, rtol=1e-5, atol=0.0)


def test_known_noise_agrees_with_the_joint_gaussian(problem):
    a, t, m0, v0 = problem
    posterior = linear_posterior(*problem, noise=0.3)
    # Conditioning the joint normal of (β, t), which inverts in the other space.
    gain = v0 @ a.T @ (a @ v0 @ a.T + 0.09 * torch.eye(12, dtype=torch.float64)).inverse()
    torch.testing.assert_close(posterior.mean, m0 + gain @ (t - a @ m0))
    torch.testing.assert_close(posterior.factor @ posterior.factor.T, v0 - gain @ a @ v0)
    normal = torch.distributions.MultivariateNormal(posterior.mean, scale_tril=posterior.factor)
    points = posterior.mean + torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(posterior.log_prob(points), normal.log_prob(points))


@pytest.mark.parametrize("noise", [None, 0.3])
def test_samples_have_the_moments(problem, noise):
    posterior = linear_posterior(*problem, noise=noise)
    with seeded(1):
        draws = posterior.sample(50_000)
    sd = posterior.standard_deviations()
    # 4.5 standard errors; the fourth moment of 12 degrees of freedom doubles that of the normal.
    assert ((draws.mean(0) - posterior.mean).abs() < 4.5 * sd / len(draws) ** 0.5).all()
    assert ((draws.std(0) / sd - 1.0).abs() < 4.5 * len(draws) ** -0.5).all()


def test_scales_of_parameters_do_not_matter(problem):
    a, t, m0, v0 = problem
    scale = torch.tensor([1e-9, 1e7], dtype=torch.float64)
    plain = linear_posterior(*problem)
    scaled = linear_posterior(a / scale, t, m0 * scale, v0 * torch.outer(scale, scale))
    torch.testing.assert_close(scaled.mean / scale, plain.mean)
    torch.testing.assert_close(scaled.factor / scale[:, None], plain.factor)


def test_data_without_noise_give_a_narrow_posterior_about_the_truth(problem):
    a, _, m0, v0 = problem
    truth = torch.tensor([1.0, -0.5], dtype=torch.float64)
    # The prior is in units of the noise: a wide one does not pull.
    posterior = linear_posterior(a, a @ truth, m0, 1e12 * v0)
    torch.testing.assert_close(posterior.mean, truth, rtol=1e-6, atol=0.0)
    assert posterior.log_prob(posterior.mean[None]).isfinite()


def test_survives_writing(problem):
    posterior = linear_posterior(*problem)
    again = StudentT.from_tensors(posterior.tensors())
    points = torch.zeros(1, 2, dtype=torch.float64)
    assert torch.equal(again.log_prob(points), posterior.log_prob(points))


def test_bad_matrices_are_refused(problem):
    a, t, m0, v0 = problem
    with pytest.raises(ShapeError, match="A \\(N, k\\)"):
        linear_posterior(a, t[:-1], m0, v0)
    with pytest.raises(BackendError, match="NaN or infinity"):
        linear_posterior(a, t * torch.nan, m0, v0)
    with pytest.raises(BackendError, match="not positive definite"):
        linear_posterior(a, t, m0, -v0)


def two_kinds(noise, error=0.0):
    """Two kinds of rows of one β, the second with zero on the right, as a free joint's."""
    generator = torch.Generator().manual_seed(5)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    beta = torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64)
    rows = draw(2_000, 2, 3)
    rows[:, 1, 0] = 0.0
    rows[:, 1, 1] = -(rows[:, 1, 2] * beta[2]) / beta[1]  # satisfies the second equation exactly
    targets = rows @ beta
    targets[:, 1] = 0.0
    targets = targets + torch.tensor(noise, dtype=torch.float64) * draw(2_000, 2)
    rows = rows + error * draw(*rows.shape)
    return rows, targets, beta


def test_noise_of_each_kind_of_row_is_found():
    rows, targets, beta = two_kinds((0.3, 0.01))
    found = row_noise(rows, targets, beta, 100.0 * torch.eye(3, dtype=torch.float64))
    # Standard error of a standard deviation: 1/√(2 N) of it; three parameters hardly count.
    limit = 4.5 / (2 * len(rows)) ** 0.5 + 3.0 / len(rows)
    assert (found / torch.tensor([0.3, 0.01]) - 1.0).abs().max() < limit


def test_rows_with_zero_on_the_right_do_not_pull_everything_to_zero():
    """Errors in the regressors shrink β; weights that grew with it would shrink it to nothing."""
    rows, targets, beta = two_kinds((0.1, 0.0), error=0.7)
    covariance = 100.0 * torch.eye(3, dtype=torch.float64)
    found = row_noise(rows, targets, beta, covariance)
    assert found.min() > 0.1
    fit = linear_posterior(
        (rows / found[:, None]).flatten(0, 1), (targets / found).flatten(), beta, covariance
    )
    assert (fit.mean > 0.3 * beta).all()
