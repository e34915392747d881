"""The verdict of a search, which is changed in one figure at a time."""

from dataclasses import replace

import pytest

from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.search.repeatability import PartEstimate, Repetition
from npdr_ppl.discovery.verdict import judge as judged
from npdr_ppl.models.effects import PreslidingFriction

pytestmark = pytest.mark.slow


@pytest.fixture
def judge(proven):
    """Returns verdict and reason of the search that found the drag, with figures changed."""
    _, options, found = proven

    def verdict(*, effects=None, unexplained=0.0, gap=None, **alarm):
        search = found.search
        last = search.rounds[-1]
        last = replace(last, alarm=replace(last.alarm, **{"p_value": 0.5, "gain": 0.0, **alarm}))
        search = replace(search, rounds=[*search.rounds[:-1], last])
        chosen = found.effects if effects is None else effects
        return judged(search, chosen, unexplained, gap or {}, options)

    return verdict


@pytest.fixture
def drag(proven):
    (finding,) = proven[2].effects
    return finding


def test_a_certain_effect_that_explains_everything_is_named(judge, drag):
    assert drag.probability > 0.9
    assert judge() == ("named", "Missing: hinge.quadratic_drag.")


def test_a_correction_is_not_missing_and_takes_no_share(judge, drag):
    correction = replace(drag, corrects="joint hinge damping", share=50.0 * drag.share)
    verdict, reason = judge(effects=[correction])
    assert verdict == "none"
    assert reason == "No effect is missing. The recording corrects joint hinge damping."
    assert judge(effects=[correction, drag]) == ("named", "Missing: hinge.quadratic_drag.")
    doubtful = replace(drag, probability=0.5, share=0.5 * drag.share)
    assert judge(effects=[correction, drag, doubtful])[0] == "ambiguous"


def test_without_effects_only_the_alarm_decides(judge):
    assert judge(effects=[], p_value=0.5)[0] == "none"
    verdict, reason = judge(effects=[], p_value=1e-3)
    assert verdict == "unknown" and "no effect explains it" in reason


@pytest.mark.parametrize(
    ("unexplained", "p_value", "gain", "verdict"),
    [
        (0.02, 1e-3, 0.0, "unknown"),  # detected, and more than one per cent
        (0.005, 1e-3, 0.0, "named"),  # detected, but negligible
        (0.02, 0.5, 0.0, "named"),  # not detected
        (0.02, 0.5, 1e6, "named"),  # not detected; certain, but at most five per cent
        (0.06, 0.5, 1e6, "unknown"),  # not detected, but certain and large
        (0.06, 0.5, 0.0, "named"),  # large, but neither detected nor certain
    ],
)
def test_a_remainder_makes_the_verdict_unknown_if_it_is_real_and_large(
    judge, unexplained, p_value, gain, verdict
):
    found, reason = judge(unexplained=unexplained, p_value=p_value, gain=gain)
    assert found == verdict
    assert ("unexplained" in reason) == (verdict == "unknown")


def test_an_implausible_value_makes_the_verdict_unknown_unless_the_effect_is_minor(judge, drag):
    strained = replace(drag, at_edge=("drag",))
    verdict, reason = judge(effects=[strained])
    assert verdict == "unknown" and "implausible value of drag" in reason
    minor = replace(strained, share=0.05 * drag.share)
    assert judge(effects=[drag, minor])[0] == "named"


def test_a_strained_law_is_compared_with_the_simple_laws_that_it_contains(judge, drag):
    strained = replace(drag, effect=PreslidingFriction("hinge"), at_edge=("deflection",))
    assert judge(effects=[strained])[1].endswith(" Compare it with hinge.coulomb_friction.")


def test_an_uncertain_effect_makes_the_verdict_ambiguous_unless_it_is_minor(judge, drag):
    names = {"hinge.quadratic_drag": 0.6, "hinge.wind": 0.37, "hinge.bias": 0.03}
    unsure = replace(drag, probability=0.6, alternatives=names)
    verdict, reason = judge(effects=[unsure])
    assert verdict == "ambiguous"
    assert reason.endswith("which effect is missing: hinge.quadratic_drag or hinge.wind.")
    minor = replace(unsure, share=0.05 * drag.share)
    assert judge(effects=[drag, minor]) == ("named", "Missing: hinge.quadratic_drag.")


def test_an_effect_that_is_not_found_again_is_not_named(judge, drag):
    parts = tuple(
        PartEstimate(part, {"drag": (value, 0.01)})
        for part, value in (("the first half", 0.1), ("the second half", 0.9))
    )
    once = replace(drag, repetition=Repetition(parts, 100.0, 10.0, is_found_again=False))
    verdict, reason = judge(effects=[once])
    assert verdict == "unknown"
    assert "different values for the first half and the second half" in reason


def test_a_minor_effect_is_not_named(judge, drag):
    minor = replace(drag, is_minor=True)
    verdict, reason = judge(effects=[minor])
    assert verdict == "unknown" and "too small to be named: hinge.quadratic_drag" in reason
    other = replace(minor, share=0.05 * drag.share)
    assert judge(effects=[drag, other]) == ("named", "Missing: hinge.quadratic_drag.")


def test_an_open_gap_makes_the_verdict_unknown(judge):
    verdict, reason = judge(gap={"rmse": Gap(3.0, 2.4, 1.0)})
    assert verdict == "unknown" and "closes only 30% of the gap" in reason
    # The error has grown, but by less than a fifth.
    verdict, reason = judge(gap={"rmse": Gap(3.0, 3.2, 1.0)})
    assert verdict == "unknown" and "closes only 0% of the gap" in reason
    verdict, reason = judge(gap={"rmse": Gap(3.0, 4.0, 1.0)})
    assert verdict == "unknown" and "grows from 3 to 4" in reason
    assert judge(gap={"rmse": Gap(3.0, 1.1, 1.0)})[0] == "named"
