"""Whether parts of a recording show an effect."""

import dataclasses

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.discovery.search import parts
from npdr_ppl.discovery.search.parts import PartResult, doubt_of, found_in_parts
from npdr_ppl.discovery.search.repeatability import HALVES
from npdr_ppl.discovery.search.settings import REPEATABILITY
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.verdict import judge, most_doubtful
from npdr_ppl.models.effects import Bias, CoulombFriction, ViscousFriction
from npdr_ppl.models.pendulum import pendulum
from tests.discovery.test_repeatability import joined
from tests.helpers.pendulum_recordings import swinging

pytestmark = pytest.mark.slow

EFFECTS = (CoulombFriction("hinge"), ViscousFriction("hinge"), Bias("hinge"))


@pytest.fixture(scope="module")
def rubbed_late():
    """A discovery in a recording whose second half alone has dry friction."""
    rollouts = joined(swinging(rollouts=2), swinging(rollouts=2, friction=0.3, seed=1))
    search = npdr.DiscoveryOptions(effects=EFFECTS)
    return npdr.discover(pendulum, rollouts, search=search)


def test_an_effect_of_all_rollouts_is_found_in_both_halves():
    search = npdr.DiscoveryOptions(effects=EFFECTS)
    found = npdr.discover(pendulum, swinging(rollouts=4, friction=0.2), search=search)
    assert found.verdict == "named"
    (friction,) = found.effects
    assert friction.effect.name == "hinge.coulomb_friction"
    assert friction.in_halves == dict.fromkeys(HALVES, True)
    record = friction.to_dict()
    assert record["in_halves"] == dict.fromkeys(HALVES, True)
    assert [part["part"] for part in record["found_in"]] == [
        *HALVES,
        *(f"the recording without rollout {number}" for number in range(4)),
    ]


def test_a_part_compares_models_with_the_same_initial_states():
    """Models with other initial states have other residuals: the comparison would be wrong."""
    search = npdr.DiscoveryOptions(effects=EFFECTS)
    found = npdr.discover(pendulum, swinging(rollouts=3, friction=0.02), search=search)
    models = list(found.search.trials.values())
    assert len(models) >= 3
    starts = [model.segments.inputs.initial_values for model in models]
    assert all(torch.equal(own, starts[0]) for own in starts)


def test_an_effect_of_one_half_only_is_not_named(rubbed_late):
    assert rubbed_late.verdict == "unknown"
    by_name = {found.effect.name: found for found in rubbed_late.effects}
    friction = by_name["hinge.coulomb_friction"]
    assert friction.in_halves == {"the first half": False, "the second half": True}
    assert not friction.can_be_named


def test_the_reason_says_which_half_contradicts_an_effect(rubbed_late):
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
    named = "hinge.coulomb_friction is contradicted by the first half of the recording"
    assert reason.startswith(named)
    # One that explains little does not change the verdict, and is not named.
    small = dataclasses.replace(friction, share=0.01)
    other = dataclasses.replace(friction, effect=Bias("hinge"), share=1.0, found_in=())
    assert judge(search, [other, small], 0.0, {}, settings) == ("named", "Missing: hinge.bias.")
    doubtful = [dataclasses.replace(each, probability=0.5) for each in (friction, other)]
    assert most_doubtful(doubtful, settings).effect.name == "hinge.bias"


def test_fits_confirm_that_a_part_does_not_show_an_effect(rubbed_late, monkeypatch):
    """They are made only where one step does not suffice, and only they count there."""
    search, fitted = rubbed_late.search, []
    refitted = parts._refitted

    def counted(part):
        fitted.append(part.segments.inputs.num_segments)
        return refitted(part)

    monkeypatch.setattr(parts, "_refitted", counted)
    first, second = found_in_parts(search)["hinge.coulomb_friction"][:2]
    assert (first.part, second.part) == HALVES
    assert first.probability < 0.5 < REPEATABILITY.certain_probability < second.probability
    halves = len(search.final.fit.offsets) // 2
    # In the first half, the model with the effect, without it, and possibly with another law.
    assert 2 <= fitted.count(halves) <= 3

    def never_moves(step, index):
        return step._whole.along(index), 0.0

    # The fit of the whole recording has friction, which the first half contradicts.
    monkeypatch.setattr(parts._Step, "along", never_moves)
    again = found_in_parts(search)["hinge.coulomb_friction"][0]
    assert again.probability == pytest.approx(first.probability, abs=0.05)


def test_a_step_that_fails_without_an_effect_is_no_evidence_for_it(monkeypatch):
    """No friction acts in the first half; only a fit to it shows that none is needed there."""
    rollouts = joined(swinging(rollouts=2), swinging(rollouts=2, friction=1.0, seed=2))
    search = npdr.DiscoveryOptions(effects=EFFECTS, repeat=False)
    found = npdr.discover(pendulum, rollouts, search=search)
    settings = dataclasses.replace(REPEATABILITY, certain_probability=0.9)
    monkeypatch.setattr(parts, "REPEATABILITY", settings)
    first, second = found_in_parts(found.search)["hinge.coulomb_friction"][:2]
    assert not first.is_found and second.is_found
    compared = parts._Compared(found.search, found.search.added[0])
    half = torch.arange(len(found.search.final.fit.offsets) // 2)
    models = compared._closest(half)
    # One step alone would say the opposite.
    plain = {name: model for name, (model, _) in models.items()}
    alone = compared._judged("", plain)
    assert alone.is_found and alone.probability >= settings.certain_probability
    assert models[""][1] > 10.0
    # The same holds for a step that fails with another law.
    other = min(set(plain) - {"", "hinge.coulomb_friction"})
    assert compared._judged("", plain, {other: 1e3}).instead == other


def test_another_law_that_explains_a_part_better_is_reported(rubbed_late):
    """In the second half, a bias stands no chance in the place of dry friction."""
    search = rubbed_late.search
    (added,) = (a for a in search.added if a.effect.name == "hinge.coulomb_friction")
    true, without = search.trials[added.place, added.effect.name], search.trials[added.place, ""]
    bias = Trials(without.segments).refitted(without, (Bias("hinge"),))
    trials = {("hinge.bias", ""): without, ("hinge.bias", "hinge.bias"): bias}
    trials["hinge.bias", "hinge.coulomb_friction"] = true
    wrong = dataclasses.replace(added, effect=Bias("hinge"), place="hinge.bias", fitting=())
    found = found_in_parts(dataclasses.replace(search, added=[wrong], trials=trials))
    second = found["hinge.bias"][1]
    assert not second.is_found
    assert second.instead == "hinge.coulomb_friction"


def test_without_repetition_no_parts_are_compared():
    search = npdr.DiscoveryOptions(effects=EFFECTS, repeat=False)
    found = npdr.discover(pendulum, swinging(rollouts=2, friction=0.2), search=search)
    assert found.effects[0].found_in == ()


def test_a_part_that_is_too_weak_to_show_an_effect_does_not_contradict_it():
    first, second = HALVES
    rest = "the recording without rollout 0"
    weak = PartResult(first, False, 0.3)
    shown = PartResult(second, True, 1.0)
    assert doubt_of([]) == ""
    assert doubt_of([weak, shown]) == ""
    assert doubt_of([weak, PartResult(second, False, 0.4)]) == (
        "was not found in the first half or the second half alone"
    )
    against = PartResult(first, False, 0.1, contradicts=True)
    assert doubt_of([against, shown]) == f"is contradicted by {first} of the recording"
    other = PartResult(rest, False, 0.1, "hinge.wind", contradicts=True)
    assert doubt_of([weak, shown, other]) == (
        f"is contradicted by {rest}, which hinge.wind explains better"
    )
