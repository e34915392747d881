"""The headline of a discovery, from the content of ``discovery.json``."""

import pytest

from npdr_ppl.discovery.headline import MOST_NAMED, headline


def found(*effects, **others):
    rows = [{"effect": name, "port": "hinge"} for name in effects]
    return {"verdict": "named", "effects": rows, **others}


def test_effects_are_listed_up_to_a_number_and_then_counted():
    names = ("bias", "spring", "cogging", "backlash")
    assert headline(found(*names[:MOST_NAMED]))[0] == (
        "Missing: constant force at hinge, spring at hinge, and cogging at hinge"
    )
    assert headline(found(*names))[0] == "Missing: constant force at hinge, and 3 more effects"


def test_corrections_and_small_effects_are_not_in_the_headline():
    result = found("servo_force_limit", "viscous_friction", "bias")
    result["effects"][1]["corrects"] = "joint hinge damping"
    result["effects"][2]["is_minor"] = True
    assert headline(result)[0] == "Missing: hinge force limit"
    reason = "No effect is missing. The recording corrects joint hinge damping."
    result |= {"verdict": "none", "effects": [result["effects"][1]], "reason": reason}
    assert headline(result) == ("No effect is missing", reason)


def test_only_effects_that_the_verdict_names_are_in_the_headline():
    named = ["hinge.bias", "hinge.cogging"]
    result = found("bias", "spring", "cogging", "backlash", named=named)
    assert headline(result)[0] == "Missing: constant force at hinge, and cogging at hinge"


@pytest.mark.parametrize(
    ("gap", "sentence"),
    [
        ({}, "The gain on held-out rollouts was not measured."),
        (
            {"rmse": {"before": 1.0, "after": 1.0, "noise_floor": 0.9, "closed": None}},
            "On held-out rollouts the original model has hardly any gap to close.",
        ),
        (
            {"rmse": {"closed": 1.04}, "dtw": {"closed": 0.25}},
            "Of the gap on held-out rollouts the revised model closes 100% in RMSE, 25% in DTW "
            "distance.",
        ),
        (
            {"rmse": {"closed": 0.5}, "dtw": {"closed": -0.2}},
            "Of the gap on held-out rollouts the revised model closes 50% in RMSE. The error on "
            "held-out rollouts has grown in DTW distance.",
        ),
    ],
)
def test_the_gain_is_said_as_it_was_measured(gap, sentence):
    assert headline(found("bias", gap=gap))[1] == sentence


def test_many_effects_are_not_repeated_in_the_reason():
    reason = (
        "The time limit of 9 s ended the search. The best explanation so far is hinge.bias and "
        "hinge.spring; not all alternatives to it were tried."
    )
    many = found(*("bias", "spring", "cogging", "backlash"), verdict="unknown", reason=reason)
    assert headline(many)[1] == (
        "The time limit of 9 s ended the search. The best explanation so far has 4 effects; not "
        "all alternatives to it were tried."
    )
