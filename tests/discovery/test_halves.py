"""Searches of both halves of a recording."""

import dataclasses

import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.halves import found_in_halves, search_halves
from npdr_ppl.discovery.search.repeatability import HALVES
from npdr_ppl.discovery.verdict import judge, most_doubtful
from npdr_ppl.errors import DataError
from npdr_ppl.models.effects import (
    Bias,
    CoulombFriction,
    PreslidingFriction,
    QuadraticDrag,
    ViscousFriction,
)
from npdr_ppl.models.pendulum import pendulum
from tests.discovery.test_repeatability import joined
from tests.helpers.pendulum_recordings import swinging

pytestmark = pytest.mark.slow

EFFECTS = (CoulombFriction("hinge"), ViscousFriction("hinge"), Bias("hinge"))


@pytest.fixture(scope="module")
def rubbed_late():
    """A discovery in a recording whose second half alone has dry friction."""
    rollouts = joined(swinging(rollouts=2), swinging(rollouts=2, friction=0.3, seed=1))
    search = npdr.DiscoveryOptions(effects=EFFECTS, repeat=True)
    return npdr.discover(pendulum, rollouts, search=search)


def test_an_effect_of_all_rollouts_is_found_in_both_halves():
    search = npdr.DiscoveryOptions(effects=EFFECTS, repeat=True)
    found = npdr.discover(pendulum, swinging(rollouts=4, friction=0.2), search=search)
    assert found.verdict == "named"
    (friction,) = found.effects
    assert friction.effect.name == "hinge.coulomb_friction"
    assert friction.in_halves == dict.fromkeys(HALVES, True)
    assert friction.to_dict()["in_halves"] == dict.fromkeys(HALVES, True)
    both = dict.fromkeys(HALVES, ["hinge.coulomb_friction"])
    assert found.to_dict()["halves"] == both


def test_an_effect_of_one_half_only_is_not_named(rubbed_late):
    assert rubbed_late.verdict == "unknown"
    by_name = {found.effect.name: found for found in rubbed_late.effects}
    friction = by_name["hinge.coulomb_friction"]
    assert friction.in_halves == {"the first half": False, "the second half": True}
    assert not friction.can_be_named


def test_the_reason_says_in_which_half_an_effect_was_not_found(rubbed_late):
    (friction,) = (
        dataclasses.replace(found, repetition=None, at_edge=(), probability=1.0, is_minor=False)
        for found in rubbed_late.effects
        if found.effect.name == "hinge.coulomb_friction"
    )
    last = rubbed_late.search.rounds[-1]
    last = dataclasses.replace(last, alarm=dataclasses.replace(last.alarm, p_value=0.5, gain=0.0))
    search = dataclasses.replace(rubbed_late.search, rounds=[last])
    settings = rubbed_late.settings
    verdict, reason = judge(search, [friction], 0.0, {}, settings)
    assert verdict == "unknown"
    assert reason == "hinge.coulomb_friction was not found in the first half of the recording."
    # One that explains little does not change the verdict, and is not named.
    small = dataclasses.replace(friction, share=0.01)
    other = dataclasses.replace(friction, effect=Bias("hinge"), share=1.0, in_halves={})
    assert judge(search, [other, small], 0.0, {}, settings) == ("named", "Missing: hinge.bias.")
    doubtful = [dataclasses.replace(each, probability=0.5) for each in (friction, other)]
    assert most_doubtful(doubtful, settings).effect.name == "hinge.bias"


def test_a_half_that_cannot_be_fitted_is_left_out(monkeypatch):
    rollouts = swinging(rollouts=2, friction=0.2)
    searcher = Searcher(pendulum, rollouts, npdr.DiscoveryOptions(effects=EFFECTS))
    first, told = searcher.fit_base(), []
    fit_base = Searcher.fit_base

    def failing(self, **options):
        if self.base.inputs.rollout.max() == 0:
            raise DataError("No fit.")
        return fit_base(self, **options)

    monkeypatch.setattr(Searcher, "fit_base", failing)
    found = search_halves(searcher, first, max_effects=1, report=told.append)
    assert set(found) == {"the second half"}
    assert "the first half is left out: No fit." in told


def test_another_form_of_a_law_counts_as_found():
    rollouts = swinging(rollouts=2, friction=0.2)
    searcher = Searcher(pendulum, rollouts, npdr.DiscoveryOptions(effects=EFFECTS))
    halves = search_halves(searcher, searcher.fit_base(), max_effects=2)
    assert found_in_halves(PreslidingFriction("hinge"), halves) == dict.fromkeys(HALVES, True)
    assert not any(found_in_halves(QuadraticDrag("hinge"), halves).values())


def test_short_recordings_are_not_halved_and_the_reason_says_so():
    search = npdr.DiscoveryOptions(effects=EFFECTS, repeat=True)
    rollouts = swinging(rollouts=1, steps=140, friction=0.3)
    options = npdr.DataOptions(segment_length=10)
    found = npdr.discover(pendulum, rollouts, search=search, options=options)
    assert found.effects[0].in_halves == {}
    assert "too short to search its halves" in found.reason
