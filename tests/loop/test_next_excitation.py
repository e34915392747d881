"""The excitation for another rollout is the one that tells most about the parameters."""

import dataclasses
import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.inference.registry import backend
from npdr_ppl.language.channels import Channel
from npdr_ppl.loop.next_excitation import (
    _shapes,
    _Trial,
    chosen_excitation,
    proposed_excitation,
)
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.loop.real_rollouts import RealRollouts
from npdr_ppl.models.pendulum import Pendulum, pendulum
from npdr_ppl.policies.playback import Chirp, Playback, Sinusoid
from npdr_ppl.posterior.infer import infer
from npdr_ppl.posterior.prepare import prepare
from npdr_ppl.preparation.data_options import DataOptions
from tests.helpers.small_loop import HandmadePendulum, small_options, small_task

UNCERTAIN = DataOptions(segment_length=5)
"""Initial states are uncertain, so that the recording has a likelihood."""

QUICK = backend("snpe-a", epochs=10, members=2, components=1)

SINUSOID = Sinusoid("torque", parameters=torch.tensor([3.0, 2.0, 0.0]))


class NarrowPendulum(Pendulum):
    """A pendulum that may not be moved by more than 0.2 rad from 0.5 rad."""

    states = (Channel("angle", "rad", 0.3, 0.7), Pendulum.states[1])


def narrow_pendulum(inputs):
    parameters = {
        "mass": pyro.sample("mass", dist.Uniform(0.3, 1.7)),
        "length": pyro.sample("length", dist.Uniform(0.3, 1.7)),
    }
    return npdr.simulate("trajectory", NarrowPendulum(), parameters, inputs)


class NoisyPendulum(HandmadePendulum):
    """A pendulum whose sensors have noise of 0.002 rad and 0.02 rad/s."""

    def rollout(self, readings, actions):
        readings = np.array(readings)
        noise = np.random.default_rng(len(readings)).standard_normal(readings.shape)
        return super().rollout(readings + [0.002, 0.02] * noise, actions)


def experiment(excitation, amplitude):
    return {"excitation": excitation, "amplitude": {"torque": amplitude}}


def test_the_experiment_that_discovery_proposes_is_what_is_recorded():
    found = proposed_excitation(experiment("reversals", 2.0), Pendulum.actions, 0.02)
    assert isinstance(found, Playback) and found.actions == ("torque",)
    commands = found.commands[:, 0]
    assert len(commands) == 4.0 / 0.02 + 1
    assert set(commands[:-1].abs().tolist()) <= {0.0, 2.0} and float(commands.abs().sum()) > 300
    assert float(commands[-1]) == 0.0
    assert proposed_excitation(None, Pendulum.actions, 0.02) is None
    assert proposed_excitation(experiment(None, 2.0), Pendulum.actions, 0.02) is None


def recorded(task, policy, episode=0):
    """Returns a rollout of the noisy pendulum."""
    target = RealRollouts(NoisyPendulum(), task, Pendulum())
    return target.collect(episode, policy, {}, seed=episode)


def inferred(model, rollouts):
    return infer(
        model, rollouts, backend=QUICK, num_simulations=100, options=UNCERTAIN, progress=False
    )


@pytest.mark.slow
def test_an_experiment_that_the_device_would_not_last_is_not_recorded():
    task = small_task(excitation=SINUSOID)
    proposal = proposed_excitation(experiment("slow_ramp", 2.0), Pendulum.actions, 0.02)
    chosen = {}
    for model in (pendulum, narrow_pendulum):
        posterior = inferred(model, recorded(task, Sinusoid("torque")))
        chosen[model] = chosen_excitation(task, task.policy, proposal, posterior, {}, seed=0)
    assert chosen[pendulum].policy is proposal
    assert chosen[narrow_pendulum].policy is not proposal
    assert math.isnan(chosen[narrow_pendulum].information["slow_ramp"])
    # Nor before anything is known of the device.
    unknown = chosen_excitation(task, task.policy, proposal, None, {}, seed=0)
    assert unknown.policy is SINUSOID and unknown.information == {}
    bare = dataclasses.replace(task, excitation=None)
    assert chosen_excitation(bare, task.policy, None, None, {}, seed=0).policy is task.policy


@pytest.mark.slow
def test_the_excitation_that_tells_most_about_the_parameters_is_recorded():
    still = Sinusoid("torque", parameters=torch.tensor([0.01, 2.0, 0.0]))
    task = dataclasses.replace(small_task(excitation=still), num_steps=150)
    first = recorded(task, SINUSOID)
    posterior = inferred(pendulum, first)
    chosen = chosen_excitation(task, task.policy, None, posterior, {}, seed=0)
    again = chosen_excitation(task, task.policy, None, posterior, {}, seed=0)
    assert again.to_dict() == chosen.to_dict()
    assert chosen.name == max(chosen.information, key=lambda name: chosen.information[name])
    assert float(chosen.policy.commands.abs().max()) <= np.abs(first.actions[0]).max() + 1e-6

    def information(excitation):
        """The information about the parameters, with a rollout of the excitation, in nats."""
        rollouts = first.concatenate(recorded(task, excitation, episode=1))
        likelihood = prepare(pendulum, rollouts, UNCERTAIN).likelihood
        return 0.5 * float(torch.logdet(torch.eye(2) + likelihood.information()))

    expected = chosen.information[chosen.name] - chosen.information["the task's excitation"]
    # What was expected is what a device with other parameters gives.
    assert information(chosen.policy) - information(still) == pytest.approx(expected, rel=0.3)


@pytest.mark.slow
def test_the_loop_records_the_excitation_and_remembers_it(tmp_path):
    still = Sinusoid("torque", parameters=torch.tensor([0.01, 2.0, 0.0]))
    task = dataclasses.replace(small_task(excitation=still), success=1e9)
    options = small_options(iterations=1, extra_rollouts=1, least_success=0.5)
    settings = {"options": UNCERTAIN, "loop": options, "out": tmp_path / "run", "progress": False}
    result = train(pendulum, NoisyPendulum(), task, **settings)
    (record,) = (d["excitation"] for d in result.iterations[0]["decisions"] if "excitation" in d)
    known = {name: value for name, value in record["information"].items() if value is not None}
    assert record["name"] == max(known, key=known.__getitem__)
    assert len(result.rollouts) == 2
    # What was recorded is read, whatever would be chosen now.
    file = tmp_path / "run/excitation_001.json"
    file.write_text(file.read_text().replace(record["name"], "another one"))
    (tmp_path / "run/iteration_0.json").unlink()
    again = train(pendulum, NoisyPendulum(), task, **settings).iterations[0]
    assert "another one" in [d.get("excitation", {}).get("name") for d in again["decisions"]]


@pytest.mark.slow
def test_excitations_are_compared_only_if_asked_for_and_stay_within_past_commands():
    task = small_task(excitation=SINUSOID)
    pushes = Chirp("torque", parameters=torch.tensor([1.0, 0.5, 2.0, 1.0, 2.0]))
    posterior = inferred(pendulum, recorded(task, pushes))
    choose = task, task.policy, None, posterior, {}
    assert chosen_excitation(*choose, seed=0, compares=False).to_dict() == {
        "name": "the task's excitation", "information": {},
    }  # fmt: skip
    # The device was pushed in one direction only, by 1 to 3 N m.
    for shape in ("reversals", "chirp", "steps"):
        commands = _shapes(posterior.preparation.rollouts, _Trial(task, posterior, {}, 0))[shape]
        inner = commands.commands[:-1]
        assert 0.9 < float(inner.min()) < 1.2 and 2.5 < float(inner.max()) < 3.1
