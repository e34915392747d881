"""The check before deploying: what it asks for, what the loop does then, and what is on disk."""

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import ModelError
from npdr_ppl.loop import npdr_loop
from npdr_ppl.loop.domains import domains_at
from npdr_ppl.loop.loop_options import Action, LoopOptions
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.loop.policy_check import Check, NextStep, check_policy, decide
from npdr_ppl.loop.risk import MeanReturn, TailMean
from npdr_ppl.models.effects import CoulombFriction
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.policies.playback import Sinusoid
from npdr_ppl.posterior.diagnostics import Decision, Diagnosis
from npdr_ppl.run_files import load_tensors
from tests.helpers.small_loop import SMALL_DATA, HandmadePendulum, small_options, small_task

# Diagnoses are scripted, so a posterior's own check need not be thorough.
pytestmark = pytest.mark.usefixtures("few_draws")

SINUSOID = Sinusoid("torque", parameters=torch.tensor([3.0, 2.0, 0.0]))


def hard_task(**changed):
    """A task that no policy can succeed at: 40 steps earn at most 40."""
    return dataclasses.replace(small_task(excitation=SINUSOID), success=1e9, **changed)


@pytest.fixture(autouse=True)
def accepted(monkeypatch):
    """Diagnoses accept, so that every further decision is the check's."""
    decisions = []

    def diagnose(data, thresholds=None, *, rounds_left=0, rollouts_left=1):
        decision = decisions.pop(0) if decisions else Decision.ACCEPT
        return Diagnosis(decision, "scripted", 1.0, 9.0, {}, {}, 0.9, 0.1, 0.5, (0.0, 1.0), 0.1)

    monkeypatch.setattr(npdr_loop, "diagnose", diagnose)
    return decisions


@pytest.fixture
def searches(monkeypatch):
    """What every policy search was told, in order: its domains and its risk."""
    noted = []
    optimise = npdr_loop.optimise_policy

    def noting(task, domains, *args, risk=None, **kwargs):
        noted.append((domains, risk))
        return optimise(task, domains, *args, risk=risk, **kwargs)

    monkeypatch.setattr(npdr_loop, "optimise_policy", noting)
    return noted


def run(folder, options, task=None, **kwargs):
    model = kwargs.pop("model", pendulum)
    task = task or small_task()
    return train(
        model,
        HandmadePendulum(),
        task,
        options=SMALL_DATA,
        loop=options,
        out=folder,
        progress=False,
        **kwargs,
    )


def verdicts(result, iteration=0):
    return [check["decision"] for check in result.iterations[iteration]["checks"]]


def test_a_policy_that_fails_in_all_draws_is_searched_for_again_from_its_first_parameters(
    tmp_path, monkeypatch
):
    begun = []
    optimise = npdr_loop.optimise_policy

    def noting(task, domains, search, start, **kwargs):
        begun.append((start.double(), kwargs["seed"]))
        return optimise(task, domains, search, start, **kwargs)

    monkeypatch.setattr(npdr_loop, "optimise_policy", noting)
    task = hard_task()
    result = run(tmp_path / "run", small_options(iterations=1, search_restarts=2), task)
    assert verdicts(result) == [NextStep.DEPLOY], "nothing is asked of the policy"
    options = small_options(iterations=1, search_restarts=2, least_success=0.9)
    result = run(tmp_path / "strict", options, task)
    assert verdicts(result) == [
        NextStep.SEARCH_AGAIN, NextStep.SEARCH_AGAIN, NextStep.TRAIN_FOR_THE_TAIL, NextStep.DEPLOY,
    ]  # fmt: skip
    own = begun[-4:]
    assert all(torch.equal(start, task.policy.parameters.double()) for start, _ in own[1:3])
    assert len({seed for _, seed in own}) == 4
    # The best of all drafts is what the run goes on with.
    returns = [check["simulated_return"]["cvar"] for check in result.iterations[0]["checks"]]
    assert result.iterations[0]["simulated_return"]["cvar"] == max(returns)


def test_each_restart_of_the_search_halves_the_spread_of_the_domains(tmp_path, searches):
    options = small_options(
        iterations=1, search_restarts=2, least_success=0.9, spread=0.2, domains="most likely",
        num_domains=200,
    )  # fmt: skip
    run(tmp_path / "run", options, hard_task())
    masses = [domains.parameters["mass"] for domains, _ in searches[1:]]
    ranges = [float((mass.max() - mass.min()) / (mass.max() + mass.min())) for mass in masses]
    # The ends of 200 uniform numbers are within 3 % of the interval's own. The domains for the
    # tail are as wide as those of the last restart.
    assert ranges == pytest.approx([0.2, 0.1, 0.05, 0.05], rel=0.03)


def test_a_policy_that_fails_in_simulation_asks_for_a_rollout_then_trains_for_the_tail(
    tmp_path, searches
):
    options = small_options(iterations=1, extra_rollouts=1, least_success=0.5, tail_share=0.4)
    result = run(tmp_path / "run", options, hard_task())
    assert verdicts(result) == [
        NextStep.ANOTHER_ROLLOUT, NextStep.TRAIN_FOR_THE_TAIL, NextStep.DEPLOY,
    ]  # fmt: skip
    # Without a likelihood, the rollout is of the task's excitation; inference has seen it.
    assert len(result.rollouts) == 2
    time = Pendulum.time_step * np.arange(40)
    assert np.allclose(result.rollouts.actions[1][:, 0], 3 * np.sin(4 * math.pi * time), atol=1e-5)
    assert len(next(iter(result.posterior.bound.data.values()))) == 2
    record = result.iterations[0]
    assert record["num_rollouts"] == 2 and len(record["real_returns"]) == 1
    assert [decision["action"] for decision in record["decisions"]] == [
        Action.TRAINED, Action.ANOTHER_ROLLOUT, Action.TRAINED,
    ]  # fmt: skip
    assert record["decisions"][1]["excitation"] == {
        "name": "the task's excitation", "information": {},
    }  # fmt: skip
    # On the prior, on each posterior, and for the tail of the second one.
    assert [risk for _, risk in searches] == [MeanReturn()] * 3 + [TailMean(0.4)]
    written = json.loads((tmp_path / "run/train.json").read_text())["iterations"][0]
    assert written["simulated_success"] == 0.0
    assert written["simulated_return"]["cvar"] < written["simulated_return"]["mean"] < 40.0
    reasons = [check["reason"] for check in written["checks"]]
    assert reasons[0].startswith(
        "The policy succeeds in 0% of its episodes (20 draws), fewer than the 50% asked for: "
    )
    assert "train for the worst 40% of the domains" in reasons[1]
    assert "even after training for the worst 40%" in reasons[2]


def test_a_policy_that_works_in_simulation_is_deployed_at_once(tmp_path, searches):
    easy = dataclasses.replace(small_task(excitation=SINUSOID), success=0.0)
    options = small_options(iterations=1, extra_rollouts=1, least_success=1.0)
    result = run(tmp_path / "run", options, easy)
    assert verdicts(result) == [NextStep.DEPLOY]
    assert len(result.rollouts) == 1 and len(searches) == 2
    assert result.iterations[0]["simulated_success"] == 1.0


def test_the_better_of_both_policies_is_deployed(tmp_path):
    options = small_options(iterations=1, least_success=0.5)
    result = run(tmp_path / "run", options, hard_task())
    checks = result.iterations[0]["checks"]
    assert [check["decision"] for check in checks] == [
        NextStep.TRAIN_FOR_THE_TAIL,
        NextStep.DEPLOY,
    ]
    tails = [check["simulated_return"]["cvar"] for check in checks]
    better = int(tails[1] > tails[0])
    assert result.iterations[0]["simulated_return"] == checks[better]["simulated_return"]
    saved = load_tensors(tmp_path / f"run/policy_1_{better}.safetensors")["parameters"]
    torch.testing.assert_close(result.policy.parameters.double(), saved)


def test_decisions_that_are_logged_only_check_and_deploy(tmp_path):
    options = small_options(iterations=1, extra_rollouts=1, least_success=0.5)
    options = dataclasses.replace(options, follows_decisions=False)
    result = run(tmp_path / "run", options, hard_task())
    assert verdicts(result) == [NextStep.DEPLOY]
    assert "only logged" in result.iterations[0]["checks"][0]["reason"]


def test_a_task_without_a_threshold_is_not_checked(tmp_path):
    options = small_options(iterations=1, extra_rollouts=1, least_success=0.5)
    task = dataclasses.replace(small_task(), success=None)
    result = run(tmp_path / "run", options, task)
    assert verdicts(result) == [NextStep.DEPLOY]
    assert result.iterations[0]["simulated_success"] is None
    assert result.iterations[0]["simulated_return"]["mean"] > 0.0
    # Read from disk, it is the same.
    assert run(tmp_path / "run", options, task).to_dict() == result.to_dict()


def test_discovery_looks_again_at_what_a_check_asked_for(tmp_path, accepted):
    accepted += [Decision.REVISE_MODEL, Decision.ACCEPT, Decision.REVISE_MODEL]
    looks = []

    def revise(model, rollouts, folder):
        looks.append((folder.name, len(rollouts)))
        return npdr.add_effect(pendulum, CoulombFriction("hinge"))

    options = small_options(iterations=1, extra_rollouts=1, least_success=0.5)
    result = run(tmp_path / "run", options, hard_task(), revise=revise)
    assert looks == [("revision_0", 1), ("revision_0_1", 2)]
    folders = sorted(path.name for path in (tmp_path / "run").glob("inference_*"))
    assert folders == [f"inference_0_{attempt}" for attempt in range(4)]
    # Resumed, the same folders are asked for, and nothing is trained again.
    looks.clear()
    again = run(tmp_path / "run", options, hard_task(), revise=revise)
    assert looks == [("revision_0", 1), ("revision_0_1", 2)]
    assert again.to_dict() == result.to_dict()


def test_the_check_counts_episodes_and_the_draws_in_which_most_succeed(tmp_path):
    options = small_options(
        iterations=1, num_checked=15, num_checked_states=4, least_success=0.75, search_restarts=0
    )
    trained = run(tmp_path / "run", options)
    task, policy, posterior = small_task(), trained.policy, trained.posterior
    seed = 5
    states = task.initial_states(4, torch.Generator().manual_seed(seed))
    domains = domains_at(posterior.prior, posterior.sample_mixture(15, seed=seed))
    each = np.empty((15, 4))
    for number in range(15):
        parameters = {name: value[number].float() for name, value in domains.parameters.items()}
        for index, state in enumerate(states):
            episodes = Pendulum(compile="never").roll_out(
                parameters, policy, state, 40, reward=task.reward
            )
            each[number, index] = float(episodes.returns)
    threshold = float(np.sort(each.ravel())[29:31].mean())
    divided = dataclasses.replace(task, success=threshold)
    shares = (each > threshold).mean(1)
    # A draw with exactly the required share of successes is reliable.
    options = dataclasses.replace(options, least_success=float(shares[shares > 0.0].min()))
    found = check_policy(divided, policy, posterior, trained.domain, options, seed=seed)
    assert found.success == pytest.approx(0.5)
    assert found.reliable_share == pytest.approx((shares > 0.0).mean())
    by_draw = each.mean(1)
    assert found.mean_return == pytest.approx(by_draw.mean(), rel=1e-4)
    assert found.tail_return == pytest.approx(np.sort(by_draw)[:3].mean(), rel=1e-4)
    assert found.num_draws == 15


def test_decisions_follow_the_share_of_successes():
    options = LoopOptions(least_success=0.9)
    good, bad = Check(0.9, 0.6, 30.0, 20.0, 200), Check(0.895, 0.6, 30.0, 20.0, 200)

    def step(check, *, searches=1, rollouts=1, is_for_tail=False):
        left = {"searches_left": searches, "rollouts_left": rollouts}
        return decide(check, options, **left, is_for_tail=is_for_tail)[0]

    assert step(good) is NextStep.DEPLOY
    assert step(bad) is NextStep.ANOTHER_ROLLOUT
    assert step(bad, rollouts=0) is NextStep.TRAIN_FOR_THE_TAIL
    assert step(bad, rollouts=0, is_for_tail=True) is NextStep.DEPLOY
    # A policy that is unreliable in nearly all draws is not helped by knowing the parameters
    # better, even if most of its episodes succeed.
    for success in (0.1, 0.8):
        unreliable = Check(success, 0.1, 3.0, 2.0, 200)
        assert step(unreliable) is NextStep.SEARCH_AGAIN
        assert step(unreliable, searches=0) is NextStep.ANOTHER_ROLLOUT
        assert step(Check(success, 0.105, 3.0, 2.0, 200)) is NextStep.ANOTHER_ROLLOUT
    assert good.is_better_than(bad) and not bad.is_better_than(good)
    assert Check(0.9, 0.6, 30.0, 21.0, 200).is_better_than(good)


def test_options_out_of_range_are_refused():
    with pytest.raises(ModelError, match="least_success must be at most 1; got 1.5"):
        LoopOptions(least_success=1.5)
    with pytest.raises(ModelError, match="tail_share must be above 0 and at most 1; got 0"):
        LoopOptions(tail_share=0)
    with pytest.raises(ModelError, match="num_checked must be at least 1; got 0"):
        LoopOptions(num_checked=0)


@pytest.mark.slow
def test_a_run_that_asks_for_rollouts_and_trains_for_the_tail_survives_kills(tmp_path):
    found = subprocess.run(
        [sys.executable, "-m", "tests.helpers.kill_runs", str(tmp_path), "10", "0", "check"],
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    summary = json.loads(found.stdout.splitlines()[-1])
    assert summary["kills"] == 10 and summary["stages"] >= 3
    record = json.loads((tmp_path / "undisturbed/run/train.json").read_text())["iterations"][0]
    assert [check["decision"] for check in record["checks"]] == [
        NextStep.ANOTHER_ROLLOUT, NextStep.TRAIN_FOR_THE_TAIL, NextStep.DEPLOY,
    ]  # fmt: skip
