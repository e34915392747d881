"""Effects that are found again in parts of a recording, and others."""

import dataclasses
import math

import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.search import repeatability
from npdr_ppl.discovery.search.repeatability import repeated_effects, repetitions
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.errors import NpdrError
from npdr_ppl.models.effects import Backlash, Bias, Cogging, CoulombFriction, Saturation
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.pendulum_recordings import swinging

OPTIONS = npdr.DataOptions(None, 30)


def joined(*parts):
    """Several recordings as the rollouts of one."""
    fields = ("readings", "actions", "time", "rewards", "stretches", "samplings")
    together = {
        name: tuple(each for part in parts for each in getattr(part, name))
        for name in fields
        if getattr(parts[0], name, None) is not None
    }
    return dataclasses.replace(parts[0], **together)


def fitted(rollouts, *effects):
    return fit_hypothesis(pendulum, rollouts, OPTIONS, effects=effects)


def test_friction_that_acts_all_the_time_is_found_again():
    found = repetitions(fitted(swinging(friction=0.2), CoulombFriction("hinge")))
    friction = found["hinge.coulomb_friction"]
    assert friction.is_found_again
    one, other = (part.strengths["magnitude"] for part in friction.estimates)
    for mean, sd in (one, other):
        assert abs(mean - 0.2) < 4.0 * sd < 0.1
    assert friction.size > 10.0 * friction.distance


@pytest.mark.parametrize("rollouts", [2, 1])
def test_friction_that_acts_in_one_half_only_is_not_found_again(rollouts):
    # With several rollouts the halves are rollouts, with one it is its second half.
    still = swinging(rollouts=rollouts, friction=0.0, seed=0)
    rubbed = swinging(rollouts=rollouts, friction=0.3, seed=1)
    found = repetitions(fitted(joined(still, rubbed), CoulombFriction("hinge")))
    friction = found["hinge.coulomb_friction"]
    assert not friction.is_found_again
    assert {part.part for part in friction.estimates} == {"the first half", "the second half"}
    assert [list(part["strengths"]) for part in friction.to_list()] == [["magnitude"]] * 2


def test_one_odd_rollout_of_several_contradicts_an_effect():
    plain = [swinging(rollouts=1, friction=0.2, seed=seed) for seed in range(4)]
    odd = swinging(rollouts=1, friction=1.2, seed=9)
    found = repetitions(fitted(joined(*plain[:2], odd, *plain[2:]), CoulombFriction("hinge")))
    friction = found["hinge.coulomb_friction"]
    assert not friction.is_found_again
    assert {part.part for part in friction.estimates} == {"rollout 2", "the other rollouts"}


def test_a_part_that_does_not_show_an_effect_contradicts_nothing():
    # Friction so weak that neither half determines it.
    found = repetitions(fitted(swinging(friction=1e-4), CoulombFriction("hinge")))
    assert found["hinge.coulomb_friction"].is_found_again


def test_short_recordings_are_not_compared_in_parts():
    assert repetitions(fitted(swinging(rollouts=1, steps=120), CoulombFriction("hinge"))) == {}


def test_effects_that_are_not_found_again_are_removed_and_the_last_one_stays():
    still, rubbed = swinging(rollouts=2), swinging(rollouts=2, friction=0.3, seed=1)
    rollouts, told = joined(still, rubbed), []
    trials = Trials(fitted(rollouts).segments)
    both = fitted(rollouts, CoulombFriction("hinge"), Bias("hinge"))
    left = repeated_effects(both, trials, told.append)
    assert left.names == ("hinge.bias",)
    assert told == ["hinge.coulomb_friction is not found again in parts of the recording"]
    alone = fitted(rollouts, CoulombFriction("hinge"))
    assert repeated_effects(alone, trials) is alone


def test_the_size_of_a_limit_is_finite_although_its_nominal_value_is_not():
    narrow, wide = (swinging(rollouts=2, seed=s) for s in (0, 1))
    strong = [tuple(2.5 * a for a in part.actions) for part in (narrow, wide)]
    told = joined(
        dataclasses.replace(narrow, actions=strong[0]),
        dataclasses.replace(wide, actions=strong[1]),
    )
    found = repetitions(fitted(told, Saturation("torque")))["torque.saturation"]
    assert math.isfinite(found.size)


def test_waves_are_compared_in_both_components():
    found = repetitions(fitted(swinging(), Cogging("hinge")))["hinge.cogging"]
    assert found.is_found_again
    assert [list(part.strengths) for part in found.estimates] == [["sine", "cosine"]] * 2


@pytest.mark.slow
def test_a_contradiction_is_confirmed_by_fits(monkeypatch):
    hypothesis = fitted(swinging(), Backlash("hinge"), CoulombFriction("hinge"))
    compared = repeatability._compared

    def contradicting(by_part, effect, pair, num_pairs):
        found = compared(by_part, effect, pair, num_pairs)
        if isinstance(by_part, repeatability._ByPart):
            return dataclasses.replace(found, is_found_again=False)
        return found

    monkeypatch.setattr(repeatability, "_compared", contradicting)
    found = repetitions(hypothesis)
    # Neither half shows play, so fits of them contradict nothing.
    assert found["hinge.backlash"].is_found_again
    assert found["hinge.coulomb_friction"].is_found_again

    def failing(*_, **__):
        raise NpdrError("the part cannot be simulated")

    monkeypatch.setattr(repeatability, "fit_segment_model", failing)
    assert not repetitions(hypothesis)["hinge.coulomb_friction"].is_found_again
