"""The NPDR loop: what it does about each decision, and that nothing is lost when it is killed."""

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.loop import npdr_loop
from npdr_ppl.loop.loop_options import Action, LoopOptions
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.models.effects import CoulombFriction
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.policies.playback import Sinusoid
from npdr_ppl.posterior.diagnostics import Decision, Diagnosis
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.run_files import load_tensors
from npdr_ppl.targets import RecordedTarget
from tests.helpers.small_loop import SMALL_DATA, HandmadePendulum, small_options, small_task

# No test is of the check of a posterior, which takes most of the time of a run this small.
pytestmark = pytest.mark.usefixtures("few_draws")


def scripted(monkeypatch, *decisions):
    """Makes diagnoses return these decisions, one after the other."""
    left = list(decisions)
    asked = []

    def diagnose(data, thresholds=None, *, rounds_left=0, rollouts_left=1):
        asked.append((rounds_left, rollouts_left))
        decision = left.pop(0) if left else Decision.ACCEPT
        return Diagnosis(
            decision, f"scripted {decision}", 1.0, 100.0, {}, {}, 0.9, 0.1, 0.5, (0.0, 1.0), 0.1
        )

    monkeypatch.setattr(npdr_loop, "diagnose", diagnose)
    return asked


def run(tmp_path, loop=None, **kwargs):
    target = kwargs.pop("target", None) or HandmadePendulum()
    task = kwargs.pop("task", None) or small_task()
    return train(
        kwargs.pop("model", pendulum),
        target,
        task,
        options=kwargs.pop("options", SMALL_DATA),
        loop=loop or small_options(iterations=1),
        out=tmp_path / "run",
        progress=False,
        **kwargs,
    )


def actions(result, iteration=0):
    return [decision["action"] for decision in result.iterations[iteration]["decisions"]]


def test_a_policy_that_holds_the_pendulum_comes_out(tmp_path):
    result = run(tmp_path, small_options(iterations=2, num_simulations=300, search_iterations=4))
    assert len(result.iterations) == 2
    assert result.rollouts.rewards is not None and len(result.rollouts) == 2
    # Without a torque the pendulum falls to hanging and earns next to nothing; weight times the
    # lever, 2.4 N m, holds it.
    assert result.iterations[-1]["sim_return"] > 20
    written = json.loads((tmp_path / "run/train.json").read_text())
    for name in ("decision", "reason", "real_return", "sim_return", "decisions"):
        assert name in written["iterations"][0]
    assert set(written["policy"]) == set(small_task().policy.names)
    # The most likely sample, and not the nominal pendulum, is the policy's internal model.
    assert written["internal_model"]["mass"] != 1.0


def test_rewards_are_those_of_readings_and_unlimited_commands(tmp_path):
    result = run(tmp_path)
    readings, rewards = result.rollouts.readings[0], result.rollouts.rewards[0]
    expected = np.exp(-10 * (readings[:-1, 0] - 0.5) ** 2 - 0.1 * readings[:-1, 1] ** 2)
    assert np.allclose(rewards, expected)
    assert result.iterations[0]["real_return"] == pytest.approx(rewards.sum())


class PaysItself(HandmadePendulum):
    """A target with a reward of its own, which has nothing to do with the task."""

    def rollout(self, readings, actions, rewards=None):
        return super().rollout(readings, actions, np.full(len(actions), -1000.0))


def test_a_targets_own_reward_is_not_mistaken_for_the_tasks(tmp_path):
    result = run(tmp_path, target=PaysItself())
    assert result.iterations[0]["real_return"] > 0.0


def test_an_accepted_posterior_trains_the_policy(tmp_path, monkeypatch):
    scripted(monkeypatch, Decision.ACCEPT)
    result = run(tmp_path)
    assert actions(result) == [Action.TRAINED]
    assert result.iterations[0]["reason"] == "scripted accept"


def test_more_rounds_are_added_while_there_are_any(tmp_path, monkeypatch):
    asked = scripted(monkeypatch, Decision.MORE_ROUNDS, Decision.MORE_ROUNDS)
    result = run(tmp_path, small_options(iterations=1, rounds=1, extra_rounds=2))
    assert actions(result) == [Action.MORE_ROUNDS, Action.MORE_ROUNDS, Action.TRAINED]
    assert [rounds_left for rounds_left, _ in asked] == [2, 1, 0]
    assert len(result.posterior.provenance.rounds) == 3


def test_a_backend_of_one_round_is_offered_no_more(tmp_path, monkeypatch):
    asked = scripted(monkeypatch)
    options = small_options(iterations=1, backend="bayessim", rounds=2, extra_rounds=2)
    result = run(tmp_path, options)
    assert asked[0][0] == (2 if result.posterior.backend.is_sequential else 0)


def test_another_rollout_excites_the_device_and_joins_the_data(tmp_path, monkeypatch):
    asked = scripted(monkeypatch, Decision.NEW_ROLLOUT)
    sinusoid = Sinusoid("torque", parameters=torch.tensor([3.0, 2.0, 0.0]))
    options = small_options(iterations=1, extra_rollouts=1)
    result = run(tmp_path, options, task=small_task(excitation=sinusoid))
    assert actions(result) == [Action.ANOTHER_ROLLOUT, Action.TRAINED]
    assert [rollouts_left for _, rollouts_left in asked] == [1, 0]
    assert len(result.rollouts) == 2
    assert len(next(iter(result.posterior.bound.data.values()))) == 2
    time = Pendulum.time_step * np.arange(40)
    assert np.allclose(result.rollouts.actions[1][:, 0], 3 * np.sin(4 * math.pi * time), atol=1e-5)


def test_policies_are_searched_with_the_internal_model_that_they_are_deployed_with(
    tmp_path, monkeypatch
):
    searched, deployed = [], []
    optimise, collect = npdr_loop.optimise_policy, npdr_loop.RealRollouts.collect

    def noted(*args, internal_model, **kwargs):
        searched.append(internal_model)
        return optimise(*args, internal_model=internal_model, **kwargs)

    def noted_collect(self, index, policy, domain, **kwargs):
        deployed.append(dict(domain))
        return collect(self, index, policy, domain, **kwargs)

    monkeypatch.setattr(npdr_loop, "optimise_policy", noted)
    monkeypatch.setattr(npdr_loop.RealRollouts, "collect", noted_collect)
    run(tmp_path, small_options(iterations=2))
    assert deployed == searched[:2]
    assert searched[0] == {name: float(v) for name, v in Pendulum().nominal().items()}
    assert searched[1] != searched[0], "the second policy assumes the most likely sample"


def test_a_widened_posterior_is_mixed_with_the_prior(tmp_path, monkeypatch):
    drawn, trained_in = [], []
    prior_domains, optimise = npdr_loop._Loop._prior_domains, npdr_loop.optimise_policy

    def noted_prior(self, number):
        drawn.append(prior_domains(self, number))
        return drawn[-1]

    def noted(task, domains, *args, **kwargs):
        trained_in.append(domains)
        return optimise(task, domains, *args, **kwargs)

    monkeypatch.setattr(npdr_loop._Loop, "_prior_domains", noted_prior)
    monkeypatch.setattr(npdr_loop, "optimise_policy", noted)
    scripted(monkeypatch, Decision.WIDEN)
    result = run(tmp_path, small_options(iterations=1, num_domains=10, prior_share=0.3))
    assert actions(result) == [Action.MIXED]
    assert [len(domains) for domains in drawn] == [10, 3]
    for name, values in trained_in[1].parameters.items():
        assert len(values) == 10
        assert torch.equal(values[7:], drawn[1].parameters[name])


def test_a_model_to_be_revised_is_handed_over_once(tmp_path, monkeypatch):
    scripted(monkeypatch, Decision.REVISE_MODEL, Decision.REVISE_MODEL)
    calls = []

    def revise(model, rollouts, folder):
        calls.append((len(rollouts), folder.name))
        return npdr.add_effect(model, CoulombFriction("hinge"))

    result = run(tmp_path, revise=revise)
    assert calls == [(1, "revision_0")]
    # The second time it is the revised model that does not fit: trained with more spread.
    assert actions(result) == [Action.REVISED, Action.SPREAD]
    assert "hinge.coulomb_friction.magnitude" in result.iterations[-1]["internal_model"]


def test_without_discovery_a_wrong_model_is_spread_wider(tmp_path, monkeypatch):
    scripted(monkeypatch, Decision.REVISE_MODEL)
    assert actions(run(tmp_path)) == [Action.SPREAD]


def test_discovery_that_finds_nothing_leaves_the_model(tmp_path, monkeypatch):
    scripted(monkeypatch, Decision.REVISE_MODEL)
    result = run(tmp_path, revise=lambda model, rollouts, folder: None)
    assert actions(result) == [Action.NOTHING_FOUND]
    assert result.model is pendulum


def test_stop_keeps_the_policy_and_ends_the_loop(tmp_path, monkeypatch):
    scripted(monkeypatch, Decision.STOP)
    result = run(tmp_path, small_options(iterations=3))
    assert len(result.iterations) == 1
    assert actions(result) == [Action.KEPT]
    assert not (tmp_path / "run/policy_1.json").exists()


def test_the_return_asked_for_ends_the_loop(tmp_path, monkeypatch):
    scripted(monkeypatch)
    result = run(tmp_path, small_options(iterations=3, stop_return=0.0))
    assert result.iterations[-1]["decision"] == Decision.STOP
    assert "return on the target" in result.iterations[-1]["reason"]
    assert len(result.iterations) == 1


def test_a_measured_return_may_be_enough_to_end_the_loop(tmp_path, monkeypatch):
    asked = scripted(monkeypatch)
    # Untrained, the policy lets the pendulum fall and earns 3; trained it holds it.
    options = small_options(
        iterations=3, starts_from_prior=False, search_iterations=4, num_simulations=300,
        stop_return=20.0, stops="measured return",
    )  # fmt: skip
    result = run(tmp_path / "other", options)
    assert [record["real_return"] > 20.0 for record in result.iterations] == [False, True]
    last = result.iterations[-1]
    assert last["decision"] == Decision.STOP and "reaches the requested return" in last["reason"]
    assert actions(result, 1) == [Action.KEPT] and last["checks"] == []
    assert len(asked) == 1  # nothing was inferred from its rollout
    assert result.deployed == 1
    assert not (tmp_path / "other/run/inference_1_0").exists()
    again = run(tmp_path / "other", options)
    assert again.to_dict() == result.to_dict()
    assert again.posterior is not None and result.posterior is not None


class Fickle(HandmadePendulum):
    """Starts some episodes with a push after which no policy holds it."""

    def __init__(self, *pushed):
        super().__init__()
        self.pushed = pushed

    def run(self, controller, num_steps, *, episode=0, seed):
        push = 20.0 if episode in self.pushed else 0.0
        self.first_state = (0.5, push)
        return super().run(controller, num_steps, episode=episode, seed=seed)


CONFIRMED = {
    "iterations": 2, "starts_from_prior": False, "search_iterations": 4, "num_simulations": 300,
    "stop_return": 20.0, "stops": "measured return", "extra_rollouts": 1,
}  # fmt: skip


def test_an_extra_rollout_confirms_a_measured_return_that_ends_the_loop(tmp_path, monkeypatch):
    asked = scripted(monkeypatch)
    result = run(tmp_path, small_options(**CONFIRMED))
    returns = result.iterations[-1]["real_returns"]
    assert len(returns) == 2 and min(returns) > 20.0
    assert actions(result, 1) == [Action.KEPT] and result.iterations[-1]["num_rollouts"] == 3
    assert len(asked) == 1
    again = run(tmp_path, small_options(**CONFIRMED))
    assert again.to_dict() == result.to_dict()


def test_a_return_that_is_not_confirmed_does_not_end_the_loop(tmp_path, monkeypatch):
    asked = scripted(monkeypatch)
    result = run(tmp_path, small_options(**CONFIRMED), target=Fickle(2))
    record = result.iterations[-1]
    assert record["real_returns"][0] > 20.0 > record["real_return"]
    assert actions(result, 1) == [Action.TRAINED]
    assert len(asked) == 2 and len(result.rollouts) == 3
    again = run(tmp_path, small_options(**CONFIRMED), target=Fickle(2))
    assert again.to_dict() == result.to_dict()


def test_confirmation_can_be_switched_off(tmp_path, monkeypatch):
    scripted(monkeypatch)
    result = run(tmp_path, small_options(**CONFIRMED, num_confirmations=0))
    assert len(result.iterations[-1]["real_returns"]) == 1 and len(result.rollouts) == 2


def test_decisions_may_be_logged_only(tmp_path, monkeypatch):
    scripted(monkeypatch, Decision.STOP, Decision.MORE_ROUNDS)
    result = run(tmp_path, small_options(follows_decisions=False))
    assert len(result.iterations) == 2
    assert actions(result, 0) == actions(result, 1) == [Action.LOGGED]


def test_recordings_serve_as_target_until_they_run_out(tmp_path):
    recorded = run(tmp_path, small_options(iterations=2)).rollouts
    bare = dataclasses.replace(recorded, rewards=None)
    result = train(
        pendulum,
        RecordedTarget(bare),
        small_task(),
        options=SMALL_DATA,
        loop=small_options(iterations=5),
        out=tmp_path / "again",
        progress=False,
    )
    assert len(result.iterations) == 2
    assert result.rollouts == recorded


def test_the_same_seed_gives_the_same_result_and_another_one_does_not(tmp_path):
    first, second = (run(tmp_path / name, seed=3).to_dict() for name in "ab")
    assert first == second
    assert run(tmp_path / "c", seed=4).to_dict()["policy"] != first["policy"]


def test_more_iterations_continue_a_finished_run(tmp_path):
    run(tmp_path, small_options(iterations=1))
    longer = run(tmp_path, small_options(iterations=2))
    at_once = run(tmp_path / "other", small_options(iterations=2))
    assert longer.to_dict() == at_once.to_dict()


@pytest.mark.slow
def test_the_best_measured_policy_is_deployed(tmp_path):
    measured = run(tmp_path / "measured", small_options(iterations=3))
    returns = [record["real_return"] for record in measured.iterations]
    best = returns.index(max(returns))
    assert measured.deployed == best
    saved = load_tensors(tmp_path / f"measured/run/policy_{best}.safetensors")["parameters"]
    torch.testing.assert_close(measured.policy.parameters.double(), saved)
    last = run(tmp_path / "last", small_options(iterations=3, deploys="last"))
    assert last.deployed is None
    saved = load_tensors(tmp_path / "last/run/policy_3.safetensors")["parameters"]
    torch.testing.assert_close(last.policy.parameters.double(), saved)
    assert last.domain == last.iterations[-1]["internal_model"]
    # Resumed, nothing changes, and a threshold that nothing reached leaves the last.
    assert run(tmp_path / "measured", small_options(iterations=3)).to_dict() == measured.to_dict()
    hopeless = dataclasses.replace(small_task(), success=1e9)
    target = HandmadePendulum()
    found = train(
        pendulum,
        target,
        hopeless,
        options=SMALL_DATA,
        loop=small_options(iterations=1),
        progress=False,
    )
    assert found.deployed is None


@pytest.mark.slow
def test_inference_may_start_from_the_last_posterior_or_the_closest_fit(tmp_path):
    options = small_options(iterations=2, num_simulations=200, start="prior")
    anew = run(tmp_path / "anew", options)
    uncertain = dataclasses.replace(SMALL_DATA, initial_state="uncertain")
    nearby = dataclasses.replace(options, start="closest fit")
    run(tmp_path / "nearby", nearby, options=uncertain)
    options = dataclasses.replace(options, start="posterior")
    onward = run(tmp_path / "onward", options)
    spreads = [
        load_tensors(tmp_path / name / "run/inference_1_0/round_0_simulations.safetensors")["z"]
        .std(0)
        .mean()
        for name in ("anew", "onward", "nearby")
    ]
    assert spreads[0] == pytest.approx(1.0, abs=0.15)  # the prior is N(0, I)
    assert spreads[1] < 0.8 * spreads[0]
    # The recording tells mass and length far more sharply; the margin is a tenth of the prior.
    assert spreads[2] < 0.5 * spreads[0]
    assert anew.iterations[0] == onward.iterations[0]
    # Nothing was simulated again, and the posterior is there, where a finished run is resumed.
    again = run(tmp_path / "onward", options)
    assert again.to_dict() == onward.to_dict()
    assert again.posterior is not None


def test_a_folder_of_another_run_is_refused(tmp_path):
    run(tmp_path)
    with pytest.raises(DataError, match="differs in the number of simulations"):
        run(tmp_path, small_options(iterations=1, num_simulations=50))


def test_bad_options_and_channels_are_refused(tmp_path):
    with pytest.raises(ModelError, match="iterations must be at least 1; got 0"):
        LoopOptions(iterations=0)
    with pytest.raises(ModelError, match="spread must be at most 1"):
        LoopOptions(spread=1.5)
    target = HandmadePendulum()
    target.sensors = target.sensors[:1]
    with pytest.raises(DataError, match="handmade has no channel velocity"):
        run(tmp_path, target=target)


@pytest.mark.slow
def test_no_rollout_is_lost_or_repeated_when_a_run_is_killed_fifteen_times(tmp_path):
    # benchmarks/killed_runs.py kills a hundred times.
    found = subprocess.run(
        [sys.executable, "-m", "tests.helpers.kill_runs", str(tmp_path), "15", "0"],
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    summary = json.loads(found.stdout.splitlines()[-1])
    assert summary["kills"] == 15
    assert summary["stages"] >= 5, "the kills all met the run at the same few places"
    assert summary["unwritten"] <= 1, "the target hardly ever wrote its episodes down"
    undisturbed = Rollouts.from_netcdf(tmp_path / "undisturbed/run/rollouts/rollout_000.nc")
    assert len(undisturbed) == 1
