"""Discovery inside the NPDR loop: when it looks, what it finds, and that this stays on disk."""

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from npdr_ppl.discovery import DiscoveryOptions
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import (
    ModelWithEffects,
    add_effect,
    num_finer_steps,
    with_finer_steps,
)
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.wider_priors import wider_sites, with_wider_priors
from npdr_ppl.loop import loop_discovery
from npdr_ppl.loop.loop_discovery import LoopDiscovery, effect_names
from npdr_ppl.loop.loop_inference import _sites
from npdr_ppl.loop.loop_options import Action
from npdr_ppl.loop.npdr_loop import train
from npdr_ppl.models.effects import CoulombFriction, InputDelay
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.policies.playback import Sinusoid
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts
from tests.helpers.small_loop import (
    SMALL_DATA,
    DryPendulum,
    discovering_options,
    swinging_task,
    without_remedies,
)


def run(folder, options, **kwargs):
    return train(
        pendulum,
        DryPendulum(),
        swinging_task(),
        options=SMALL_DATA,
        loop=options,
        out=folder,
        progress=False,
        **kwargs,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of two iterations on a pendulum with dry friction."""
    folder = tmp_path_factory.mktemp("loop") / "run"
    options = discovering_options(iterations=2)
    with without_remedies():
        return folder, options, run(folder, options)


@pytest.mark.slow
def test_friction_that_the_model_lacks_is_found_before_anything_is_inferred(finished):
    folder, _, result = finished
    record = json.loads((folder / "train.json").read_text())["iterations"][0]
    assert record["effects"] == ["hinge.coulomb_friction"]
    first = record["decisions"][0]
    assert first["decision"] == "revise the model"
    assert first["action"] == Action.REVISED
    assert "hinge.coulomb_friction" in first["reason"] and "p = " in first["reason"]
    # Nothing was inferred with the model as it was.
    assert not (folder / "inference_0_0").exists() and (folder / "inference_0_1").exists()
    assert effect_names(result.model) == ["hinge.coulomb_friction"]
    assert "hinge.coulomb_friction.magnitude" in record["parameters"]


@pytest.mark.slow
def test_what_was_found_is_in_the_run_as_a_model_and_as_json(finished):
    folder = finished[0]
    for index in range(2):
        found = json.loads((folder / f"revision_{index}/discovery.json").read_text())
        assert found["verdict"] in ("named", "ambiguous", "unknown")
        (effect,) = found["effects"]
        assert effect["effect"] == "coulomb_friction"
        # The true 0.6 fits these short, stiffly held rollouts hardly worse than 0.2, which the
        # half-normal prior prefers: sizes are for the tests of discovery itself.
        assert effect["parameters"]["magnitude"]["mean"] > 0.1
        source = (folder / f"revision_{index}/revised_model.py").read_text()
        names = {}
        exec(compile(source, "revised_model.py", "exec"), names)
        assert effect_names(names["revised_model"]) == ["hinge.coulomb_friction"]


@pytest.mark.slow
def test_a_resumed_run_reads_what_was_found(finished, monkeypatch):
    folder, options, result = finished

    def searched(*args, **kwargs):
        raise AssertionError("searched again")

    monkeypatch.setattr(loop_discovery, "discover", searched)
    again = run(folder, options)
    assert again.to_dict() == result.to_dict()
    assert effect_names(again.model) == ["hinge.coulomb_friction"]
    assert _sites(again.posterior.prior) == _sites(result.posterior.prior)


@pytest.mark.slow
def test_after_a_diagnosis_the_model_as_it_was_has_a_posterior_too(tmp_path):
    with without_remedies():
        result = run(tmp_path / "run", discovering_options("after diagnosis", extra_rounds=0))
    decisions = result.iterations[0]["decisions"]
    assert [d["action"] for d in decisions][0] == Action.REVISED
    assert decisions[0]["decision"] == "revise the model"
    assert decisions[0]["diagnosis"]["contraction"]  # of the model as it was
    assert (tmp_path / "run/inference_0_0").exists() and (tmp_path / "run/inference_0_1").exists()
    assert "hinge.coulomb_friction.magnitude" in result.iterations[0]["parameters"]


def test_decisions_that_are_logged_only_look_for_nothing(tmp_path):
    result = run(tmp_path / "run", discovering_options(follows_decisions=False))
    assert result.iterations[0]["effects"] == []
    assert not (tmp_path / "run/revision_0").exists()


def test_a_rollout_too_short_to_tell_anything_by_leaves_the_model(tmp_path):
    short = dataclasses.replace(swinging_task(), num_steps=30)
    target = DryPendulum()
    result = train(
        pendulum,
        target,
        short,
        options=SMALL_DATA,
        loop=discovering_options(),
        out=tmp_path / "run",
        progress=False,
    )
    assert result.model is pendulum
    assert result.iterations[0]["effects"] == []


@pytest.mark.slow
def test_a_rollout_that_ended_early_is_followed_by_an_excitation(tmp_path):
    class Stops(DryPendulum):
        def run(self, controller, num_steps, *, episode=0, seed):
            steps = 40 if episode == 0 else num_steps
            return super().run(controller, steps, episode=episode, seed=seed)

    sinusoid = Sinusoid("torque", parameters=torch.tensor([3.0, 0.7, 0.0]))
    task = dataclasses.replace(swinging_task(), excitation=sinusoid)
    options = discovering_options(extra_rollouts=1)
    settings = {"out": tmp_path / "run", "progress": False}
    result = train(pendulum, Stops(), task, options=SMALL_DATA, loop=options, **settings)
    decisions = result.iterations[0]["decisions"]
    assert decisions[0]["action"] == Action.ANOTHER_ROLLOUT
    assert "40 steps of 200" in decisions[0]["reason"]
    assert decisions[1]["action"] == Action.REVISED
    assert result.rollouts.lengths == (40, 200)
    time = 0.02 * np.arange(200)
    sine = 3 * np.sin(2 * math.pi * 0.7 * time)
    assert np.allclose(result.rollouts.actions[1][:, 0], sine, atol=1e-4)
    # Taken over from disk, it is the same run.
    assert (
        train(pendulum, Stops(), task, options=SMALL_DATA, loop=options, **settings).to_dict()
        == result.to_dict()
    )


def test_segments_are_shorter_where_rollouts_ended_early():
    rollouts = Rollouts.from_arrays(
        readings=np.zeros((1, 501, 2)), actions=np.zeros((1, 500, 1)),
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=0.002,
    )  # fmt: skip
    # Sixteen segments instead of five of 100 steps.
    assert segment_options(rollouts).segment_length == 31
    with pytest.raises(DataError, match="500 steps are too few for 8 segments of 100 steps"):
        segment_options(rollouts, DataOptions(segment_length=100))


def test_a_revision_begins_at_the_model_that_the_loop_was_given(tmp_path):
    """An effect that was named too early is removed when more rollouts contradict it."""
    model = add_effect(pendulum, CoulombFriction("hinge"))
    search = DiscoveryOptions(effects=(InputDelay("torque"),))
    look = LoopDiscovery(model, SMALL_DATA, search, seed=0)
    (tmp_path / "discovery.json").write_text(
        json.dumps(
            {
                "reason": "Missing: torque.input_delay.",
                "alarm": {"p_value": 0.001},
                "finer_steps": 1,
                "effects": [{"effect": "input_delay", "port": "torque"}],
                "parameters": {
                    "torque.input_delay.delay": {"mean": 0.01},
                    "hinge.coulomb_friction.magnitude": {"mean": None},
                },
            }
        )
    )
    revision = look.look(at_rest(0.02), tmp_path)
    assert isinstance(revision.model, ModelWithEffects)
    assert effect_names(revision.model) == ["hinge.coulomb_friction", "torque.input_delay"]
    assert num_finer_steps(revision.model) == 1
    assert revision.reason == "Missing: torque.input_delay. (Alarm: p = 0.001.)"
    assert effect_names(look.model) == ["hinge.coulomb_friction"]
    # Inference goes on from where discovery fitted it, as far as that is a number.
    assert {k: float(v) for k, v in revision.parameters.items()} == {
        "torque.input_delay.delay": pytest.approx(0.01)
    }


def test_a_revision_has_the_priors_with_which_it_was_found(tmp_path):
    """Devices with slow sampling have longer delays, and a prior may have been too narrow."""
    (tmp_path / "discovery.json").write_text(
        json.dumps(
            {
                "reason": "Missing: torque.input_delay.",
                "alarm": {"p_value": 0.001},
                "wider_priors": [["length"], ["length", "mass"]],
                "effects": [{"effect": "input_delay", "port": "torque"}],
                "parameters": {"torque.input_delay.delay": {"mean": 0.09}},
            }
        )
    )
    rollouts = at_rest(0.05)
    look = LoopDiscovery(pendulum, SMALL_DATA, DiscoveryOptions(), seed=0)
    revision = look.look(rollouts, tmp_path)
    assert revision.model is not None
    priors = Prior(revision.model, (rollouts.inputs(None, "recorded"),)).distributions
    assert float(priors["torque.input_delay.delay"].high) == pytest.approx(0.15)
    # Each time, a range of 1.4 grows by its own width at both ends.
    assert float(priors["mass"].high) == pytest.approx(1.7 + 1.4)
    assert float(priors["length"].high) > 1.7 + 1.4 + 2.0
    assert wider_sites(revision.model) == [["length"], ["length", "mass"]]


def test_what_the_loops_own_model_has_is_not_applied_again(tmp_path):
    own = with_finer_steps(with_wider_priors(pendulum, ["length"]))
    found = {
        "reason": "Nothing.", "alarm": {"p_value": 0.4}, "finer_steps": 1,
        "wider_priors": [["length"]], "effects": [], "parameters": {},
    }  # fmt: skip
    (tmp_path / "discovery.json").write_text(json.dumps(found))
    look = LoopDiscovery(own, SMALL_DATA, DiscoveryOptions(), seed=0)
    assert look.look(at_rest(0.05), tmp_path).model is None
    more = {**found, "finer_steps": 2, "wider_priors": [["length"], ["mass"]]}
    (tmp_path / "discovery.json").write_text(json.dumps(more))
    revised = look.look(at_rest(0.05), tmp_path).model
    assert wider_sites(revised) == [["length"], ["mass"]] and num_finer_steps(revised) == 2


def at_rest(time_step):
    return Rollouts.from_arrays(
        readings=np.zeros((1, 41, 2)), actions=np.zeros((1, 40, 1)),
        channel_names=("angle", "velocity"), action_names=("torque",), time_step=time_step,
    )  # fmt: skip


@pytest.mark.slow
def test_a_run_that_discovers_survives_kills(tmp_path):
    # Of this seed's moments one is early in the search, the other near the end of the run.
    found = subprocess.run(
        [sys.executable, "-m", "tests.helpers.kill_runs", str(tmp_path), "2", "1", "discover"],
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    assert json.loads(found.stdout.splitlines()[-1])["kills"] == 2
