"""The correction for proposals, against the analytic posterior of linear-Gaussian models.

The independent route never divides: a proposal takes the prior's place in the joint Gaussian of
parameters and features, component by component, and the components' evidences give the weights.
"""

import pytest
import torch
from torch.distributions import MultivariateNormal

from npdr_ppl.inference.parts.mixtures.gaussian_mixture import GaussianMixture
from npdr_ppl.inference.parts.mixtures.mixture_density import (
    MixtureDensityNetwork,
    mixture_at,
    perceptron,
)
from npdr_ppl.inference.parts.mixtures.proposal_correction import (
    correct_regression,
    proposal_of,
    tilt_forms,
    whiten_forms,
)
from npdr_ppl.inference.parts.training.preconditioning import fit_preconditioner
from npdr_ppl.randomness import seeded

F64 = torch.float64
GAIN = torch.tensor([[1.0, 0.5], [0.0, 1.0], [0.3, -0.6]], dtype=F64)
NOISE = 0.25 * torch.eye(3, dtype=F64)
OBSERVATION = torch.tensor([0.6, -0.4, 0.7], dtype=F64)

PRIOR = GaussianMixture.from_moments(
    torch.ones(1), torch.zeros(1, 2, dtype=F64), torch.eye(2, dtype=F64)[None]
)
PROPOSALS = {
    "gaussian": GaussianMixture.from_moments(
        torch.ones(1),
        torch.tensor([[0.8, -0.3]], dtype=F64),
        torch.tensor([[[0.3, 0.1], [0.1, 0.2]]], dtype=F64),
    ),
    "mixture": GaussianMixture.from_moments(
        torch.tensor([0.2, 0.5, 0.3]),
        torch.tensor([[0.8, -0.3], [-1.5, 0.4], [0.1, 2.0]], dtype=F64),
        torch.tensor(
            [[[0.3, 0.1], [0.1, 0.2]], [[0.05, 0.0], [0.0, 0.9]], [[1.0, 0.0], [0.0, 1.0]]],
            dtype=F64,
        ),
    ),
}


def tilted(density, forms):
    """Returns the mixture proportional to q(z) t(z), of K J components."""
    d = density.means.shape[1]
    factors = density.precision_factors
    rows = torch.cat((factors, -factors @ density.means[..., None]), -1)
    joint = (rows.mT @ rows)[:, None] + forms
    lower = torch.linalg.cholesky(joint[..., :-1, :-1])
    means = torch.cholesky_solve(-joint[..., :-1, -1:], lower)[..., 0]
    left_over = joint[..., -1, -1] + (joint[..., -1, :-1] * means).sum(-1)
    log_det = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)[:, None]
    log_det = log_det - lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    log_weights = density.log_weights[:, None] + log_det - 0.5 * left_over
    return GaussianMixture(log_weights.flatten(), means.view(-1, d), lower.mT.reshape(-1, d, d))


def exact_posterior(prior, x=OBSERVATION):
    """Conditions the joint Gaussian of (z, x) on x for every component of a prior over z."""
    log_weights, means, covariances = [], [], []
    components = zip(prior.log_weights, prior.means, prior.covariances, strict=True)
    for log_weight, mean, covariance in components:
        evidence = GAIN @ covariance @ GAIN.T + NOISE
        gain = covariance @ GAIN.T @ evidence.inverse()
        means.append(mean + gain @ (x - GAIN @ mean))
        covariances.append(covariance - gain @ GAIN @ covariance)
        log_weights.append(log_weight + MultivariateNormal(GAIN @ mean, evidence).log_prob(x))
    weights = torch.stack(log_weights).softmax(0)
    return GaussianMixture.from_moments(weights, torch.stack(means), torch.stack(covariances))


def assert_equal(actual, expected):
    torch.testing.assert_close(actual.weights, expected.weights)
    torch.testing.assert_close(actual.means, expected.means)
    torch.testing.assert_close(actual.covariances, expected.covariances)


@pytest.mark.parametrize("kind", PROPOSALS)
def test_the_forms_are_those_of_the_ratio(kind):
    proposal = PROPOSALS[kind]
    with seeded(0):
        z = torch.randn(20, 2, dtype=F64)
    joint = torch.cat((z, torch.ones(20, 1, dtype=F64)), -1)
    exponents = torch.einsum("na,jab,nb->nj", joint, tilt_forms(proposal), joint)
    log_ratio = proposal.log_prob(z) - PRIOR.log_prob(z)
    torch.testing.assert_close((-0.5 * exponents).logsumexp(-1), log_ratio)


@pytest.mark.parametrize("kind", PROPOSALS)
def test_tilting_the_posterior_gives_the_exact_proposal_posterior(kind):
    proposal = PROPOSALS[kind]
    assert_equal(tilted(exact_posterior(PRIOR), tilt_forms(proposal)), exact_posterior(proposal))


def test_dividing_the_proposal_posterior_gives_the_exact_posterior():
    proposal = PROPOSALS["gaussian"]
    assert_equal(tilted(exact_posterior(proposal), -tilt_forms(proposal)), exact_posterior(PRIOR))


@pytest.mark.parametrize("kind", PROPOSALS)
def test_the_network_evaluates_the_proposal_posterior(kind):
    # A network of random weights, so that its mixture differs from row to row.
    with seeded(1):
        network = MixtureDensityNetwork(2, 16, 4, perceptron(3, (16,)))
        network.head.weight.data.mul_(30).add_(torch.randn_like(network.head.weight) * 0.2)
        z, x = torch.randn(30, 2), torch.randn(30, 3)
    preconditioner = fit_preconditioner(z + x[:, :2], x)
    f = preconditioner.features(x)
    u = preconditioner.whiten(z, f)
    forms = tilt_forms(PROPOSALS[kind])
    by_row = whiten_forms(
        forms.expand(30, *forms.shape), preconditioner.factor, preconditioner.shift(f)
    )
    with torch.no_grad():
        plain = network(u, f) + preconditioner.log_det
        both = network(torch.cat((u, by_row.flatten(1).float()), -1), f) + preconditioner.log_det
    for row in range(30):
        mixture = mixture_at(network, preconditioner, x[row])
        point = z[row : row + 1].double()
        expected = torch.cat((mixture.log_prob(point), tilted(mixture, forms).log_prob(point)))
        actual = torch.stack((plain[row], both[row])).double()
        torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-3)


def test_corrected_regression_is_the_posteriors():
    n, proposal = 40_000, PROPOSALS["gaussian"]
    with seeded(2):
        z = proposal.sample(n)
        x = z @ GAIN.T.float() + 0.5 * torch.randn(n, 3)
    fitted = correct_regression(fit_preconditioner(z, x), proposal)
    f = fitted.features(OBSERVATION[None].float())
    expected = exact_posterior(PRIOR)
    sd = expected.covariances[0].diagonal().sqrt().float()
    # Piecewise linear normal scores bend the regression a little, besides errors of 1 / sqrt(n).
    assert ((fitted.shift(f)[0] - expected.means[0].float()).abs() < 0.1 * sd).all()
    covariance = fitted.factor @ fitted.factor.T
    error = (covariance - expected.covariances[0].float()).abs() / torch.outer(sd, sd)
    assert (error < 0.15).all()


def test_regression_on_features_that_say_nothing_becomes_the_prior():
    proposal = PROPOSALS["gaussian"]
    for seed in range(5):
        with seeded(seed):
            z, x = proposal.sample(2000), torch.randn(2000, 4)
        fitted = correct_regression(fit_preconditioner(z, x), proposal)
        covariance = fitted.factor @ fitted.factor.T
        # By chance features seem to inform, but never to take information away: a variance of
        # 0.14, the proposal's least, has a standard error of 0.14 (2 / 2000)^0.5.
        assert torch.linalg.eigvalsh(covariance).max() <= 1 + 1e-5
        assert torch.linalg.eigvalsh(covariance).min() > 1 / (1 + 4.5 * (2 / 2000) ** 0.5 / 0.14)


def test_proposals_are_no_wider_than_the_prior():
    wide = GaussianMixture.from_moments(
        torch.ones(2),
        torch.tensor([[2.0, 0.0], [-2.0, 0.0]]),
        torch.tensor([[[4.0, 0.5], [0.5, 0.2]], [[0.1, 0.0], [0.0, 0.3]]]),
    )
    for kind, components in [("gaussian", 1), ("mixture", 4)]:
        proposal = proposal_of([wide, wide], kind)
        assert len(proposal.means) == components
        assert torch.linalg.eigvalsh(proposal.covariances).max() <= 1 + 1e-9
        forms = tilt_forms(proposal)[:, :-1, :-1]
        assert torch.linalg.eigvalsh(forms).min() > -1e-9
    torch.testing.assert_close(proposal.covariances[1], wide.covariances[1])
    narrow = exact_posterior(PRIOR)
    assert_equal(proposal_of([narrow, narrow], "gaussian"), narrow)
