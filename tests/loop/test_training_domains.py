"""How far the domains that the loop trains a policy in are spread about the posterior's draws."""

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.inference.registry import backend
from npdr_ppl.loop.domains import domains_at
from npdr_ppl.loop.loop_options import Action, LoopOptions
from npdr_ppl.loop.training_domains import training_domains
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.data_options import DataOptions
from tests.helpers.pendulum_recordings import swinging

SPREAD = 0.1
"""Parameters are multiplied by numbers uniform in 1 ± 0.1."""


@pytest.fixture(scope="module")
def posterior():
    return npdr.infer(
        pendulum, swinging(rollouts=1, steps=60), num_simulations=100, progress=False,
        backend=backend("snpe-a", epochs=5, members=2, components=1),
        options=DataOptions("all/10", 20, "recorded"),
    )  # fmt: skip


@pytest.fixture
def domains(posterior):
    """Returns the parameters of the training domains after an action."""

    def of(action, *, num_restarts=0, **options):
        def from_prior(number):
            return domains_at(posterior.prior, prior_draws(posterior, number))

        return training_domains(
            posterior, LoopOptions(num_domains=50, **options), action, from_prior=from_prior,
            seed=0, most_likely_seed=0, num_restarts=num_restarts,
        ).parameters  # fmt: skip

    return of


def prior_draws(posterior, number):
    generator = torch.Generator().manual_seed(1)
    return torch.randn(number, posterior.prior.num_parameters, generator=generator).double()


def factors(spread, plain):
    """Returns by what each parameter of each domain was multiplied, less one."""
    return {name: spread[name] / plain[name] - 1.0 for name in ("mass", "length")}


@pytest.mark.parametrize("kind", ["posterior", "most likely"])
def test_domains_are_spread_about_the_posteriors_draws(domains, posterior, kind):
    plain = domains(Action.TRAINED, spread=0.0, domains=kind)
    away = factors(domains(Action.TRAINED, spread=SPREAD, domains=kind), plain)
    if kind == "most likely":
        likeliest = posterior.most_likely(seed=0)
        assert len(plain["mass"].unique()) == 1
        assert plain["mass"][0] == pytest.approx(float(likeliest["mass"]), rel=1e-5)
    else:
        draws = posterior.sample(50)
        assert plain["mass"].tolist() == pytest.approx(draws["mass"].tolist())
    for factor in away.values():
        # The farthest of fifty uniform numbers is within the last tenth but once in 200 times.
        assert 0.9 * SPREAD < factor.abs().max() <= SPREAD * (1 + 1e-5)
    # Each parameter of each domain has a number of its own.
    assert len(away["mass"].unique()) == 50
    assert not torch.allclose(away["mass"], away["length"])


@pytest.mark.parametrize(
    ("action", "num_restarts", "factor"),
    [
        (Action.SPREAD, 0, 2.0),
        (Action.NOTHING_FOUND, 0, 2.0),
        (Action.TRAINED, 1, 0.5),
        (Action.TRAINED, 2, 0.25),
        (Action.SPREAD, 1, 1.0),
    ],
)
def test_a_wrong_model_doubles_the_spread_and_each_restart_halves_it(
    domains, action, num_restarts, factor
):
    plain = domains(Action.TRAINED, spread=0.0)
    usual = factors(domains(Action.TRAINED, spread=SPREAD), plain)
    other = factors(domains(action, spread=SPREAD, num_restarts=num_restarts), plain)
    for name, away in other.items():
        torch.testing.assert_close(away, factor * usual[name], rtol=0, atol=1e-5)


def test_a_widened_posterior_has_draws_of_the_prior_among_its_domains(domains, posterior):
    mixed = domains(Action.MIXED, spread=SPREAD, prior_share=0.3)
    assert len(mixed["mass"]) == 50
    expected = domains_at(posterior.prior, prior_draws(posterior, 15)).parameters
    usual = domains(Action.TRAINED, spread=SPREAD, prior_share=0.3)
    for name, values in expected.items():
        assert torch.equal(mixed[name][35:], values)
        assert not bool(torch.isin(values, usual[name]).any())
