"""Searches of both halves of a recording."""

import dataclasses

import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.halves import HALVES, found_in_halves, search_halves
from npdr_ppl.discovery.verdict import judge
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


def test_an_effect_of_one_half_only_is_not_named(rubbed_late):
    assert rubbed_late.verdict == "unknown"
    by_name = {found.effect.name: found for found in rubbed_late.effects}
    friction = by_name["hinge.coulomb_friction"]
    assert friction.in_halves == {"the first half": False, "the second half": True}
    assert not friction.can_be_named


def test_the_reason_says_that_no_effect_is_in_both_halves(rubbed_late):
    search = dataclasses.replace(rubbed_late.search, is_approximate=False)
    lost = [
        dataclasses.replace(found, repetition=None, at_edge=(), probability=1.0)
        for found in rubbed_late.effects
    ]
    verdict, reason = judge(search, lost, 0.0, {}, rubbed_late.settings)
    assert verdict == "unknown"
    assert reason.startswith("No large effect was found in both halves")


def test_another_form_of_a_law_counts_as_found():
    rollouts = swinging(rollouts=2, friction=0.2)
    searcher = Searcher(pendulum, rollouts, npdr.DiscoveryOptions(effects=EFFECTS))
    halves = search_halves(searcher, searcher.fit_base(), max_effects=2)
    assert found_in_halves(PreslidingFriction("hinge"), halves) == dict.fromkeys(HALVES, True)
    assert not any(found_in_halves(QuadraticDrag("hinge"), halves).values())


def test_short_recordings_are_not_halved():
    rollouts = swinging(rollouts=1, steps=70)
    searcher = Searcher(
        pendulum,
        rollouts,
        npdr.DiscoveryOptions(effects=EFFECTS),
        data_options=npdr.DataOptions(None, 10),
    )
    assert search_halves(searcher, searcher.fit_base(), max_effects=1) == {}
