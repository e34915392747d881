"""How sure parameters are: weighted draws where the normal approximation bends."""

import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.models.effects import Spring
from npdr_ppl.workflows.discovery.credible import Draws, estimates, posterior_draws
from npdr_ppl.workflows.discovery.hypothesis import fit_hypothesis
from npdr_ppl.workflows.discovery.projection import Projection


def fitted(effects):
    """A pendulum that lacks nothing, fitted with effects that it does not have."""
    case = make_case("pendulum", "null", (), seed=2001)
    binding = npdr.DiscoveryOptions().binding(case.fit)
    return fit_hypothesis(case.model, case.fit, binding, effects=effects)


def test_where_the_model_is_linear_all_draws_count():
    hypothesis = fitted(())
    draws = posterior_draws(hypothesis, seed=0)
    assert float(1.0 / draws.weights.square().sum()) > 0.9 * len(draws.z)
    moved = draws.z - hypothesis.fit.z
    curvature = Projection(hypothesis).parameter_information_by_segment.sum(0)
    parabola = torch.einsum("ni,ij,nj->n", moved, curvature, moved)
    misfit = Projection(hypothesis).misfit_at(draws.z) - Projection(hypothesis).misfit
    assert torch.allclose(misfit, parabola, atol=0.3, rtol=0.1)


def test_draws_that_leave_a_bent_ridge_do_not_count():
    # Of a spring that is hardly there, stiffness times rest is known, and neither of them.
    hypothesis = fitted((Spring("hinge"),))
    projection = Projection(hypothesis)
    draws = posterior_draws(hypothesis, seed=0)
    beyond = projection.misfit_at(draws.z) - projection.misfit
    plain, weighted = float(beyond.mean()), float(draws.weights @ beyond)
    assert weighted < 0.7 * plain
    assert weighted < len(hypothesis.fit.z)
    assert float(1.0 / draws.weights.square().sum()) >= len(draws.z) / 8


def test_draws_are_taken_as_often_as_they_weigh():
    torch.manual_seed(0)
    draws = Draws(
        torch.arange(4.0)[:, None].double(), torch.tensor([0.5, 0.0, 0.25, 0.25]).double()
    )
    taken = draws.resampled(400)[:, 0]
    assert torch.bincount(taken.long(), minlength=4).tolist() == [200, 0, 100, 100]


@pytest.mark.parametrize("seed", [0, 1])
def test_intervals_hold_the_mass_they_say(seed):
    hypothesis = fitted(())
    found = estimates(hypothesis, {}, seed=seed)
    for estimate in found.values():
        low, high = estimate.hdi_94
        # Of a normal distribution, 94 % lie within 1.881 standard deviations.
        assert (high - low) / (2.0 * estimate.sd) == pytest.approx(1.881, rel=0.05)
        assert 0.5 * (low + high) == pytest.approx(estimate.mean, abs=0.2 * estimate.sd)


def test_draws_that_cannot_be_simulated_do_not_count(monkeypatch):
    hypothesis = fitted(())

    def misfit_at(self, z):
        # All but a few fail, and those differ by more than weights can bear.
        return torch.where(torch.arange(len(z)) < 5, 1e3 * torch.arange(len(z)), torch.nan)

    monkeypatch.setattr(Projection, "misfit_at", misfit_at)
    draws = posterior_draws(hypothesis, seed=0)
    assert float(draws.weights.sum()) == pytest.approx(1.0)
    assert float(draws.weights[5:].sum()) == 0.0
