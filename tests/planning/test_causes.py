"""The causes of a run with a learned law, whose file is among the added effects or not."""

import json
from dataclasses import replace
from statistics import NormalDist

import pytest

from npdr_ppl.discovery.proof.surviving_causes import VERSION
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.models.effect_additions import add_file
from npdr_ppl.models.effects import effect_class
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.planning.causes import at_time_step, causes_of_prior, causes_of_run, prior_of
from tests.helpers.effect_files import CUBIC


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A folder of a search that learned the law of ``CUBIC``; no effect is added yet."""
    monkeypatch.setenv("NPDR_EFFECTS", str(tmp_path / "added"))
    folder = tmp_path / "run"
    folder.mkdir()
    cause = {
        "effects": [{"effect": "learned_hinge", "port": "hinge", "constants": {}, "priors": {}}],
        "probability": 1.0,
        "parameters": {"mass": 1.0, "length": 1.0, "hinge.learned_hinge.cubic": 0.01},
        "coordinates": [0.0] * 3,
        "precision": [[float(i == j) for j in range(3)] for i in range(3)],
    }
    kept = {
        "version": VERSION,
        "causes": [cause],
        "separations": [[0.0]],
        "noise": {},
        "independent_share": 1.0,
        "segment_length": 20,
        "time_step": 0.02,
        "seconds": 5.0,
        "actions": {},
        "channels": {},
    }
    law = {"port": "hinge", "effect": "learned_hinge", "formula": "−c v³"}
    found = {"verdict": "learned", "learned": {"laws": [law]}, "surviving_causes": kept}
    (folder / "discovery.json").write_text(json.dumps(found))
    (folder / "learned_effect.py").write_text(CUBIC)
    return folder


def test_a_learned_law_is_a_cause_once_its_file_is_added(run):
    with pytest.raises(DataError, match="npdr effects --add .*learned_effect.py"):
        causes_of_run(run, pendulum)
    add_file(run / "learned_effect.py")
    (cause,) = causes_of_run(run, pendulum).causes
    assert cause.name == "hinge.learned_hinge"


@pytest.fixture
def delayed(run):
    """The same folder, with a delay of the sensors as the cause, at the middle of its prior."""
    found = json.loads((run / "discovery.json").read_text())
    (cause,) = found["surviving_causes"]["causes"]
    delay = {"effect": "sensor_delay", "port": "angle,velocity", "constants": {}, "priors": {}}
    cause["effects"] = [delay]
    cause["parameters"] = {"mass": 1.0, "length": 1.0, "angle,velocity.sensor_delay.delay": 0.03}
    (run / "discovery.json").write_text(json.dumps(found))
    return run


def parameters(known):
    (cause,) = known.causes
    values = prior_of(cause.model, known.time_step).to_parameters(cause.z[None])
    return {name: float(value) for name, value in values.items()}


def test_the_prior_of_a_delay_is_that_of_the_recorded_time_step(delayed):
    # It reaches three steps of 0.02 s, and the delay is at its middle.
    found = parameters(causes_of_run(delayed, pendulum))
    assert found["angle,velocity.sensor_delay.delay"] == pytest.approx(0.03)


def test_another_time_step_keeps_the_parameters_and_how_well_they_are_known(delayed):
    known = causes_of_run(delayed, pendulum)
    moved = at_time_step(known, 0.016)
    assert parameters(moved) == pytest.approx(parameters(known))
    assert moved.segment_length == 25  # 0.4 s
    # Where the priors are wider by a factor, a standard deviation is a smaller share of them.
    one, other = known.causes[0], moved.causes[0]
    assert float(one.z[2]) == pytest.approx(0.0) and float(other.z[2]) > 0.1
    precision = other.precision.diagonal() / one.precision.diagonal()
    density = NormalDist().pdf(float(other.z[2])) / NormalDist().pdf(0.0)
    assert precision.tolist() == pytest.approx([1.0, 1.0, (0.048 / 0.06 * density) ** 2], rel=1e-2)
    assert at_time_step(known, 0.02) is known


def test_the_prior_of_an_effect_is_that_of_the_search(delayed):
    found = json.loads((delayed / "discovery.json").read_text())
    prior = {"distribution": "Uniform", "low": 0.0, "high": 0.4}
    (effect,) = found["surviving_causes"]["causes"][0]["effects"]
    effect["priors"] = {"delay": prior}
    (delayed / "discovery.json").write_text(json.dumps(found))
    found = parameters(causes_of_run(delayed, pendulum))
    assert found["angle,velocity.sensor_delay.delay"] == pytest.approx(0.2)


def test_a_delay_longer_than_the_prior_at_another_time_step_gets_a_sentence(delayed):
    found = json.loads((delayed / "discovery.json").read_text())
    found["surviving_causes"]["causes"][0]["coordinates"] = [0.0, 0.0, 0.5]  # 41 ms
    (delayed / "discovery.json").write_text(json.dumps(found))
    with pytest.raises(DataError, match="closer to that of the recording, 0.02 s"):
        at_time_step(causes_of_run(delayed, pendulum), 0.008)


def test_draws_of_a_prior_are_drawn_again_at_another_time_step():
    # At 0.02 s the prior of the delay reaches farther than at 0.005 s.
    model = add_effect(pendulum, effect_class("input_delay")("torque"))
    known = causes_of_prior(model, seed=0)
    moved = at_time_step(known, 0.005)
    for cause in moved.causes:
        values = prior_of(cause.model, moved.time_step).to_parameters(cause.z[None])
        assert 0.0 < float(values["torque.input_delay.delay"]) < 0.05
    assert at_time_step(moved, 0.02).causes == known.causes


def test_another_law_of_the_same_port_is_not_taken_for_it(run, tmp_path):
    other = tmp_path / "other.py"
    other.write_text(
        CUBIC.replace('law = "−c v³"', 'law = "−c v⁵"').replace("POWER = 3", "POWER = 5")
    )
    add_file(other)
    with pytest.raises(DataError, match="learned the law −c v³, but .* has another, −c v⁵"):
        causes_of_run(run, pendulum)


@pytest.mark.parametrize(
    ("stored", "found"),
    [
        ((None, None), (0.5, 0.5)),
        ((0.6, 0.2), (0.75, 0.25)),
        ((0.9, 0.0), (1.0, 0.0)),
    ],
)
def test_probabilities_have_a_sum_of_one_and_are_above_zero(stored, found):
    drawn = causes_of_prior(pendulum, seed=0)
    causes = tuple(
        replace(cause, probability=value)
        for cause, value in zip(drawn.causes, stored, strict=False)
    )
    known = replace(drawn, causes=causes, is_prior=False)
    assert known.probabilities == pytest.approx(found, abs=1e-5)
    assert min(known.probabilities) > 0.0
