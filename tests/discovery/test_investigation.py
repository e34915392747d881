"""The whole search: the same seed, the same result; and recordings and options it refuses."""

import pytest
from hidden_rigs import make_case, places

import npdr_ppl as npdr
from npdr_ppl.errors import DataError
from npdr_ppl.models.effects import CoulombFriction, QuadraticDrag


@pytest.mark.slow
def test_the_same_seed_gives_the_same_result():
    place = ("hinge", "quadratic_drag")
    case = make_case("pendulum", "one", (place,), strength=0.3, seed=2001)
    effects = (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    options = npdr.DiscoveryOptions(effects=effects, max_effects=1)
    first, second = (npdr.discover(case.model, case.fit, search=options) for _ in range(2))
    assert first.effects[0].to_dict() == second.effects[0].to_dict()
    assert first.alarm == second.alarm


@pytest.mark.slow
def test_angles_in_degrees_from_which_simulations_fail_are_converted():
    spoilt = places("cart_pole", "bad_data", 1040)[1]
    case = make_case("cart_pole", "bad_data", spoilt, seed=1040)
    found = npdr.discover(case.model, case.fit)
    (note,) = found.problems
    assert "recorded in degrees" in note
    assert (found.verdict, found.effects) == ("none", [])
    with pytest.raises(DataError, match=r"rad; are these degrees\?$"):
        npdr.discover(case.model, case.fit, options=npdr.DataOptions(strict=True))


def test_numbers_in_place_of_held_out_rollouts_are_refused():
    case = make_case("pendulum", "null", (), seed=2001)
    with pytest.raises(DataError, match=r"takes rollouts, e.g. rollouts\[\[3\]\]"):
        npdr.discover(case.model, case.fit, holdout=(3,))


def test_too_short_a_recording_is_refused():
    case = make_case("pendulum", "null", (), seed=2001)
    with pytest.raises(DataError, match="too few"):
        npdr.discover(case.model, case.fit, options=npdr.DataOptions(segment_length=500))


@pytest.mark.parametrize("wrong", [{"max_effects": -1}, {"false_alarm_rate": 0.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(DataError, match=next(iter(wrong))):
        npdr.DiscoveryOptions(**wrong)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (npdr.DataOptions(initial_state="recorded"), "initial_state must be 'uncertain'"),
        (npdr.DataOptions(noise="model"), "noise must be 'auto'"),
        (npdr.DataOptions(segment_length=None), "at least 2; got whole rollouts"),
        (npdr.DataOptions(segment_length=1), "at least 2; got 1"),
        (npdr.DiscoveryOptions(), "options takes a DataOptions"),
    ],
)
def test_options_that_discovery_cannot_use_are_refused(options, sentence):
    case = make_case("pendulum", "null", (), seed=2001)
    with pytest.raises(DataError, match=sentence):
        npdr.discover(case.model, case.fit, options=options)
