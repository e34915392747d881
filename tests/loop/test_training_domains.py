"""How far the domains that the loop trains a policy in are spread about the posterior's draws."""

import pytest
import torch

from npdr_ppl.loop import npdr_loop
from npdr_ppl.loop.loop_options import Action
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.diagnostics import Decision, Diagnosis
from tests.helpers.small_loop import HandmadePendulum, small_options, small_task

SHARE = 0.1
"""Plain spread: parameters are multiplied by numbers uniform in 1 ± 0.1."""


def trained_in(monkeypatch, decision, *, revise=None, **changed):
    """Returns the domains that the policy is trained in after one iteration, and what was done."""
    seen = []

    def diagnose(data, thresholds=None, *, rounds_left=0, rollouts_left=1):
        return Diagnosis(
            decision, f"scripted {decision}", 1.0, 100.0, {}, {}, 0.9, 0.1, 0.5, (0.0, 1.0), 0.1
        )

    optimise = npdr_loop.optimise_policy

    def noted(task, domains, *args, **kwargs):
        seen.append(domains)
        return optimise(task, domains, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(npdr_loop, "diagnose", diagnose)
        patch.setattr(npdr_loop, "optimise_policy", noted)
        options = small_options(
            iterations=1, num_domains=50, num_initial_states=1, search_iterations=1, **changed
        )
        result = npdr_loop.train(
            pendulum, HandmadePendulum(), small_task(), options, revise=revise, progress=False
        )
    assert len(seen) == 2  # on the prior, and on the posterior
    return seen[1].parameters, result.iterations[0]["decisions"][-1]["action"]


def deviations(domains, centres):
    """Returns how far each parameter of each domain is from the draw it was made of, relative."""
    return {name: (domains[name] / centres[name] - 1.0).abs() for name in ("mass", "length")}


@pytest.mark.parametrize("domains", ["posterior", "most likely"])
def test_domains_are_the_posteriors_draws_spread_apart(monkeypatch, domains):
    centres, _ = trained_in(monkeypatch, Decision.ACCEPT, spread=0.0, domains=domains)
    plain, action = trained_in(monkeypatch, Decision.ACCEPT, spread=SHARE, domains=domains)
    assert action == Action.TRAINED
    if domains == "most likely":
        assert len(centres["mass"].unique()) == 1
    for away in deviations(plain, centres).values():
        # The farthest of fifty uniform numbers is within the last tenth but once in 200 times.
        assert 0.9 * SHARE < away.max() <= SHARE * (1 + 1e-5)
    # Each parameter of each domain has a number of its own.
    assert len((plain["mass"] / centres["mass"]).unique()) == 50
    assert not torch.allclose(plain["mass"] / centres["mass"], plain["length"] / centres["length"])


def test_where_the_model_is_wrong_domains_are_farther_apart_than_plain_spread_allows(monkeypatch):
    centres, _ = trained_in(monkeypatch, Decision.ACCEPT, spread=0.0)

    def share_beyond(decision, **options):
        """Returns what was done, and the share of parameters that plain spread cannot reach."""
        found, action = trained_in(monkeypatch, decision, spread=SHARE, **options)
        away = torch.cat(list(deviations(found, centres).values()))
        return action, float((away > SHARE * (1 + 1e-5)).double().mean())

    assert share_beyond(Decision.ACCEPT) == (Action.TRAINED, 0.0)
    nothing = {"revise": lambda model, rollouts, folder: None}
    # Half of them where the spread is doubled; four standard errors of 100 are a fifth.
    for options, expected in (({}, Action.SPREAD), (nothing, Action.NOTHING_FOUND)):
        action, share = share_beyond(Decision.REVISE_MODEL, **options)
        assert action == expected and share > 0.3
