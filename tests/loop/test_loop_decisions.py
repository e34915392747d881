"""Decisions of the loop from real posteriors of real rollouts, and the actions that follow."""

import pyro
import pyro.distributions as dist
import pytest

import npdr_ppl as npdr
from npdr_ppl.inference.registry import backend
from npdr_ppl.loop import npdr_loop
from npdr_ppl.loop.loop_options import Action
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.posterior.diagnostics import Decision, Thresholds
from npdr_ppl.preparation.data_options import DataOptions
from tests.helpers.pendulum_recordings import product
from tests.helpers.small_loop import (
    DryPendulum,
    NoisyPendulum,
    accurate_pendulum,
    small_options,
    swinging_task,
)

pytestmark = pytest.mark.slow

SPREAD = 0.1


def too_long(inputs):
    """A pendulum whose prior of the length excludes the target's 0.8 m."""
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))
    length = pyro.sample("length", dist.Uniform(0.9, 1.7))
    simulator = Pendulum(integrator="rk4")
    return npdr.simulate("trajectory", simulator, {"mass": mass, "length": length}, inputs)


def with_idle(inputs):
    """A pendulum with a parameter that does nothing."""
    pyro.sample("idle", dist.Uniform(0.0, 1.0))
    return accurate_pendulum(inputs)


@pytest.fixture
def loop(monkeypatch):
    """Runs one iteration; returns its decisions, and the masses that the policy is trained in."""
    domains = []
    optimise = npdr_loop.optimise_policy

    def noting(task, drawn, *args, **kwargs):
        domains.append(drawn.parameters["mass"])
        return optimise(task, drawn, *args, **kwargs)

    monkeypatch.setattr(npdr_loop, "optimise_policy", noting)

    def run(model=accurate_pendulum, target=None, gain=0.2, **changed):
        options = {
            "iterations": 1, "rounds": 1, "extra_rounds": 0, "num_simulations": 100,
            "backend": backend("snpe-a", epochs=10, members=2, components=1),
            "spread": SPREAD,
            "domains": "most likely", "num_domains": 100, "search_iterations": 1,
            "num_initial_states": 1, "starts_from_prior": False,
        }  # fmt: skip
        result = npdr_loop.train(
            model, target or NoisyPendulum(), swinging_task(gain),
            options=DataOptions("score", 20, "uncertain"),
            loop=small_options(**{**options, **changed}), progress=False,
        )  # fmt: skip
        return result.iterations[0]["decisions"], domains[-1]

    return run


def relative_range(values):
    return float((values.max() - values.min()) / (values.max() + values.min()))


def test_a_complete_model_is_accepted_and_the_policy_trained_on_its_posterior(loop):
    (decision,), masses = loop()
    assert (decision["decision"], decision["action"]) == (Decision.ACCEPT, Action.TRAINED)
    # The ends of a hundred uniform numbers are within some per cent of the interval's own.
    assert relative_range(masses) == pytest.approx(SPREAD, rel=0.1)


def test_hidden_friction_doubles_the_spread_of_the_domains(loop):
    (decision,), masses = loop(target=DryPendulum(), gain=0.5)
    assert (decision["decision"], decision["action"]) == (Decision.REVISE_MODEL, Action.SPREAD)
    assert "an effect is missing" in decision["reason"]
    assert relative_range(masses) == pytest.approx(2 * SPREAD, rel=0.1)


def test_a_prior_that_excludes_the_target_adds_draws_of_the_prior(loop):
    (decision,), masses = loop(too_long, prior_share=0.3)
    assert (decision["decision"], decision["action"]) == (Decision.WIDEN, Action.MIXED)
    assert "length fits best at about" in decision["reason"]
    assert relative_range(masses[:70]) == pytest.approx(SPREAD, rel=0.1)
    assert relative_range(masses[70:]) > 0.5  # of the prior, Uniform(0.3, 1.7)


def test_an_estimator_that_has_not_converged_gets_the_extra_rounds(loop, few_draws):
    decisions, _ = loop(extra_rounds=1)
    assert [(d["decision"], d["action"]) for d in decisions] == [
        (Decision.MORE_ROUNDS, Action.MORE_ROUNDS), (Decision.WIDEN, Action.MIXED),
    ]  # fmt: skip
    assert "no rounds are left" in decisions[1]["reason"]


@pytest.mark.parametrize(
    ("model", "contraction", "decision", "reason"),
    [
        (with_idle, 0.2, Decision.NEW_ROLLOUT, "nothing of idle"),
        (product, 0.4, Decision.OTHER_EXCITATION, "density and volume only in combination"),
    ],
)
def test_undetermined_parameters_ask_for_a_rollout_while_there_is_one(
    loop, model, contraction, decision, reason
):
    thresholds = Thresholds(contraction=contraction)
    (first, second), _ = loop(model, extra_rollouts=1, thresholds=thresholds)
    assert (first["decision"], first["action"]) == (decision, Action.ANOTHER_ROLLOUT)
    assert reason in first["reason"]
    # With no rollout left, what is determined is used.
    assert (second["decision"], second["action"]) == (Decision.ACCEPT, Action.TRAINED)
