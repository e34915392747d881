"""The preconditioner, against closed forms and independent routes."""

import math

import pytest
import torch

from npdr_ppl.inference.parts.training.preconditioning import fit_preconditioner
from npdr_ppl.randomness import seeded


def simulations(n=4000, d=3, num_features=4, seed=0):
    with seeded(seed):
        z = torch.randn(n, d)
        x = z @ torch.randn(d, num_features) + torch.randn(n, num_features)
    return z, x


def test_normal_scores_are_standard_normal_and_monotone():
    with seeded(1):
        x = torch.randn(5000, 1).exp() ** 3  # heavy tail
    scores = fit_preconditioner(torch.zeros(5000, 1), x).features(x)
    order = x[:, 0].argsort()
    assert (scores[order, 0].diff() >= 0).all()
    # Kolmogorov-Smirnov distance of the sample to its own quantile map is only that of the knots.
    uniform = torch.special.ndtr(scores[order, 0])
    grid = torch.arange(1, 5001) / 5000
    assert (uniform - grid).abs().max() < 0.02


def test_whitening_is_inverted_and_has_the_stated_determinant():
    z, x = simulations()
    preconditioner = fit_preconditioner(z, x)
    f = preconditioner.features(x)
    u = preconditioner.whiten(z, f)
    torch.testing.assert_close(preconditioner.unwhiten(u, f), z, rtol=1e-4, atol=1e-4)
    jacobian = torch.autograd.functional.jacobian(
        lambda row: preconditioner.whiten(row[None], f[:1])[0], z[0]
    )
    assert preconditioner.log_det.item() == pytest.approx(
        jacobian.det().abs().log().item(), rel=1e-4
    )
    # Residuals of 4000 rows: standard errors of their moments are at most 1.5 / sqrt(4000).
    assert u.mean(0).abs().max() < 0.02
    torch.testing.assert_close(u.T.cov(), torch.eye(3), rtol=0, atol=0.06)


def test_leave_one_out_covariance_is_honest_with_many_features():
    # 60 useless features and 100 rows: in-sample residuals would be half as wide.
    with seeded(3):
        z, x = torch.randn(100, 1), torch.randn(100, 60)
        fresh_z, fresh_x = torch.randn(5000, 1), torch.randn(5000, 60)
    preconditioner = fit_preconditioner(z, x)
    u = preconditioner.whiten(fresh_z, preconditioner.features(fresh_x))
    assert 0.7 < u.std() < 1.3


def test_clips_and_reports_what_lies_outside():
    z, x = simulations()
    preconditioner = fit_preconditioner(z, x)
    far = torch.tensor([1e8, -1e8, 0.0, math.inf])
    scores = preconditioner.features(far[None])[0]
    assert preconditioner.outside(far).tolist() == [True, True, False, True]
    limit = preconditioner.scores[-1]
    assert scores[0] == limit and scores[1] == -limit and scores[3] == limit


def test_a_constant_feature_says_nothing():
    z, x = simulations()
    x[:, 2] = 3.0
    preconditioner = fit_preconditioner(z, x)
    assert (preconditioner.features(x)[:, 2] == 0).all()
    other = x.clone()
    other[:, 2] = 4.0
    assert torch.equal(preconditioner.features(other), preconditioner.features(x))
    assert preconditioner.whiten(z, preconditioner.features(x)).isfinite().all()


def test_raw_arrays_are_standardised_robustly():
    with seeded(4):
        x = 5 + 2 * torch.randn(2001, 6, 2)
        x[0] = 1e9
        x[:, 3, 1] = 7.0
    preconditioner = fit_preconditioner(torch.randn(2001, 1), x, is_raw=True)
    f = preconditioner.features(x)
    assert f.shape == x.shape and f.abs().max() <= 10
    assert abs(f[1:, 0].mean()) < 0.1 and abs(f[1:, 0].std() - 1) < 0.1
    assert (f[1:, 3, 1] == 0).all()


@pytest.mark.parametrize("n", [10, 30])
def test_few_simulations_give_a_finite_preconditioner(n):
    z, x = simulations(n, d=5, num_features=20)
    preconditioner = fit_preconditioner(z, x)
    assert preconditioner.whiten(z, preconditioner.features(x)).isfinite().all()
