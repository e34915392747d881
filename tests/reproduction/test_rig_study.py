"""The study of returns: policies are trained without the rig's secrets and judged on the rig."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from npdr_ppl.loop.control_task import control_task
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.furuta_targets import furuta_target
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.reproduction import rig_study
from npdr_ppl.reproduction.rig_study import METHODS, Outcome, run_method, study, summarise
from npdr_ppl.run_files import read_json, write_json
from npdr_ppl.targets.base import TargetDomain, end_episode
from tests.helpers.small_rig_study import NUM_STEPS, TINY_DATA, tiny_options


@pytest.fixture
def task():
    return replace(control_task("furuta-swing-up"), num_steps=NUM_STEPS)


class Upright(TargetDomain):
    """A rig that stands upright by itself, after some episodes of an honest rig.

    Standing earns one a step. In a simulation the pole begins at the bottom, so that nothing but
    this rig gives such returns.
    """

    name = "upright"
    sensors, actions, time_step = Furuta.sensors, Furuta.actions, Furuta.time_step

    def __init__(self, num_honest=0, num_steps=NUM_STEPS):
        self.honest, self.num_honest, self.steps = (
            furuta_target("furuta-hard"),
            num_honest,
            num_steps,
        )
        self.num_episodes_run = 0

    def run(self, controller, num_steps, *, episode=0, seed):
        self.num_episodes_run += 1
        steps = min(num_steps, self.steps)
        if self.num_episodes_run <= self.num_honest:
            return self.honest.run(controller, steps, episode=episode, seed=seed)
        state = np.array([0.0, math.pi, 0.0, 0.0])
        commands = [self.limit(controller(state, k * self.time_step)) for k in range(steps)]
        end_episode(controller, state)
        return self.rollout(np.tile(state, (steps + 1, 1)), commands)


@pytest.mark.parametrize("method", ["default gains", "nominal", "prior"])
def test_policies_that_need_no_rig_meet_it_only_to_be_judged(task, method):
    rig = Upright()
    found = run_method(METHODS[method], rig, task, tiny_options(), seed=0, num_episodes=2)
    assert found.returns == pytest.approx((NUM_STEPS, NUM_STEPS))
    assert rig.num_episodes_run == 2 and found.iterations == ()
    # In the nominal simulator the pole is still down, whatever the rig does.
    assert 0.0 < found.sim_return < 0.5 * NUM_STEPS
    honest = furuta_target("furuta-hard")
    again = run_method(METHODS[method], honest, task, tiny_options(), seed=0, num_episodes=1)
    assert again.sim_return == found.sim_return
    assert again.returns[0] < 0.5 * NUM_STEPS


@pytest.mark.slow
def test_returns_of_the_loop_are_of_fresh_episodes_on_the_rig(task):
    rig = Upright(num_honest=1)
    found = run_method(
        METHODS["bayessim"], rig, task, tiny_options(), options=TINY_DATA, seed=0, num_episodes=2
    )
    # One episode to learn from, and two to be judged by.
    assert rig.num_episodes_run == 3
    (record,) = found.iterations
    assert record["num_rollouts"] == 1 and record["real_return"] < 0.5 * NUM_STEPS
    assert found.returns == pytest.approx((NUM_STEPS, NUM_STEPS))
    assert found.sim_return < 0.5 * NUM_STEPS


def test_too_short_a_rollout_leaves_the_policy_of_the_prior(task, caplog):
    rig = Upright(num_honest=1, num_steps=3)
    method = METHODS["bayesian-linear-regression"]
    options = DataOptions("all", 100, "recorded", "float32")
    found = run_method(method, rig, task, tiny_options(), options=options, seed=0, num_episodes=1)
    assert found.iterations == () and "got one of 4" in caplog.text
    trained = run_method(METHODS["prior"], Upright(), task, tiny_options(), seed=0, num_episodes=1)
    assert found.sim_return == trained.sim_return


def test_policies_are_trained_in_the_nominal_domain_or_in_draws_of_the_prior(task, monkeypatch):
    seen = []
    optimise = rig_study.optimise_policy

    def noted(task, domains, *args, **kwargs):
        seen.append(domains.parameters)
        return optimise(task, domains, *args, **kwargs)

    monkeypatch.setattr(rig_study, "optimise_policy", noted)
    for method in ("default gains", "nominal", "prior"):
        run_method(METHODS[method], Upright(), task, tiny_options(), seed=0, num_episodes=1)
    nominal, drawn = seen  # default gains are not trained
    expected = {name: float(value) for name, value in Furuta().nominal().items()}
    assert {name: float(value) for name, value in nominal.items()} == expected
    for name in ("pole_length", "arm_length", "motor_resistance"):
        assert len(drawn[name].unique()) == 3
        assert bool((drawn[name] / expected[name] - 1.0).abs().max() < 1.0)


@pytest.mark.slow
def test_what_a_folder_holds_is_not_run_again(tmp_path, monkeypatch):
    short = replace(control_task("furuta-swing-up"), num_steps=NUM_STEPS)
    monkeypatch.setattr(rig_study, "control_task", lambda name: short)
    noted = []

    def run(seeds):
        return study(
            ["default gains"], ["furuta-easy", "furuta-hard"], seeds, tiny_options(), tmp_path,
            progress=False, note=lambda *row: noted.append(row[:3]),
        )["default gains"]  # fmt: skip

    first = run([0, 1])
    assert list(first) == ["furuta-easy", "furuta-hard"]
    assert noted == [("default gains", rig, seed) for rig in first for seed in (0, 1)]
    returns = {outcome.returns for several in first.values() for outcome in several}
    assert len(returns) == 4  # every rig and seed is another
    file = tmp_path / "default_gains__furuta-hard__1/outcome.json"
    marked = read_json(file) | {"sim_return": -1.0}
    write_json(file, marked)
    other = tmp_path / "default_gains__furuta-easy__0/outcome.json"
    other.unlink()
    again = run([0, 1, 2])
    assert again["furuta-hard"][1].sim_return == -1.0
    assert len(again["furuta-hard"]) == 3
    # A run that was lost is made again, with the same result.
    assert again["furuta-easy"][0] == first["furuta-easy"][0]
    assert tuple(again["furuta-hard"][1].returns) == first["furuta-hard"][1].returns


def test_a_rig_and_seed_counts_once_by_its_mean():
    outcomes = {
        "easy": [Outcome((2_000.0, 1_000.0), 100.0), Outcome((1_600.0,), 200.0)],
        "hard": [Outcome((0.0, 0.0, 0.0), 300.0)],
    }
    found = summarise(outcomes, success=1_550.0)
    means = torch.tensor([1_500.0, 1_600.0, 0.0]).double()
    assert found["return_rig"]["mean"] == pytest.approx(float(means.mean()))
    assert found["return_rig"]["std"] == pytest.approx(float(means.std(correction=0)))
    assert found["return_sim"]["mean"] == pytest.approx(200.0)
    assert found["success"] == pytest.approx(1 / 3) and found["runs"] == 3
