"""Two effects at one place, which look like a third one."""

import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.screening.groups import ranked_pairs
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import Screening
from npdr_ppl.discovery.screening.sensitivities import sensitivities
from npdr_ppl.discovery.search.convergence import converge_likeliest
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.shortlist import fit_groups, fit_shortlist
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.models.effects import (
    ActuatorLag,
    Bias,
    CoulombFriction,
    FrictionDrift,
    HardeningSpring,
    InputDelay,
    PreslidingFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)

pytestmark = pytest.mark.slow

RUBBED = ("hinge", "coulomb_friction"), ("hinge", "quadratic_drag")
LATE = ("torque", "input_delay"), ("torque", "actuator_lag")


def searcher_of(hidden, strength, *effects):
    case = make_case("pendulum", "two_at_one_place", hidden, strength=strength, seed=2001)
    return Searcher(case.model, case.fit, npdr.DiscoveryOptions(effects=effects))


@pytest.fixture(scope="module")
def rubbed():
    """A searcher of a recording with dry friction and drag, and the results before any effect."""
    effects = (
        CoulombFriction("hinge"),
        QuadraticDrag("hinge"),
        ViscousFriction("hinge"),
        HardeningSpring("hinge"),
        Bias("hinge"),
    )
    searcher = searcher_of(RUBBED, (0.2, 0.1), *effects)
    return searcher, searcher.look(searcher.fit_base())


def test_the_gain_of_a_pair_is_that_of_both_changes_together(rubbed):
    searcher, first = rubbed
    projection = Projection(first.averaged)
    effects = (CoulombFriction("hinge"), QuadraticDrag("hinge"))
    variants = list(sensitivities(first.averaged, effects))
    screening = Screening(projection)
    for variant in variants:
        screening.add(variant)
    (pair,) = ranked_pairs(projection, screening.ranking())
    both = projection.scores(torch.cat([v.change for v in variants], dim=-1)).gain(slice(None))
    # The priors of the strengths take a little of it.
    assert pair.gain == pytest.approx(both, rel=0.02)
    assert pair.gain > max(candidate.gain for candidate in screening.ranking())
    assert all(size > 0.0 for own in pair.sizes for size in own)
    assert set(pair.parameters) == {
        "hinge.coulomb_friction.magnitude",
        "hinge.quadratic_drag.drag",
    }


def test_pairs_are_ranked_by_their_joint_gain(rubbed):
    _, first = rubbed
    gains = [pair.gain for pair in first.pairs]
    assert gains == sorted(gains, reverse=True)
    assert {"hinge.coulomb_friction", "hinge.quadratic_drag"} in [p.names for p in first.pairs[:2]]


def test_a_pair_takes_the_place_of_an_effect_that_stood_for_both(rubbed):
    searcher, first = rubbed
    wrong = searcher.trials.refitted(first.hypothesis, (ViscousFriction("hinge"),))
    rounds = [first, searcher.look(wrong)]
    worse = searcher.trials.refitted(wrong, (*wrong.effects, Bias("hinge")))
    found = searcher._with_likelier_pair(rounds, worse, 5)
    assert set(found.names) == {"hinge.coulomb_friction", "hinge.quadratic_drag"}


def test_a_pair_that_explains_no_more_is_not_taken(rubbed):
    searcher, first = rubbed
    one = searcher.trials.refitted(first.hypothesis, (CoulombFriction("hinge"),))
    rounds = [first, searcher.look(one)]
    right = searcher.trials.refitted(one, (*one.effects, QuadraticDrag("hinge")))
    assert searcher._with_likelier_pair(rounds, right, 5) is right
    assert searcher._with_likelier_pair(rounds[:1], one, 5) is one


def test_a_pair_does_not_exceed_the_greatest_number_of_effects(rubbed):
    searcher, first = rubbed
    wrong = searcher.trials.refitted(first.hypothesis, (ViscousFriction("hinge"),))
    rounds = [first, searcher.look(wrong)]
    assert searcher._with_likelier_pair(rounds, wrong, 1) is wrong
    assert len(searcher._with_likelier_pair(rounds, wrong, 2).effects) == 2


def test_a_pair_that_cannot_be_simulated_is_left_out(rubbed, monkeypatch):
    searcher, first = rubbed
    along = Trials.with_effects

    def without_drag(self, effects, starts):
        has_drag = "hinge.quadratic_drag" in [effect.name for effect in effects]
        return None if has_drag else along(self, effects, starts)

    monkeypatch.setattr(Trials, "with_effects", without_drag)
    found = fit_groups(searcher.trials, first.hypothesis, first.pairs[:3], first.hypothesis)
    kept = {pair.name for pair in first.pairs[:3] if "hinge.quadratic_drag" not in pair.names}
    assert set(found) == kept


def test_a_simple_law_converges_beside_three_laws_that_contain_it(rubbed, monkeypatch):
    searcher, first = rubbed
    law = CoulombFriction("hinge")
    richer = (FrictionDrift("hinge"), PreslidingFriction("hinge"), StribeckFriction("hinge"))
    base = searcher.trials.refitted(first.hypothesis, (QuadraticDrag("hinge"),))
    trials = {
        effect.name: searcher.trials.refitted(base, (*base.effects, effect))
        for effect in (law, *richer)
    }
    asked = []
    fits = Trials.fits

    def seen(self, wanted, simulator):
        asked.extend(fit.effects[-1].name for fit in wanted)
        return fits(self, wanted, simulator)

    monkeypatch.setattr(Trials, "fits", seen)
    converge_likeliest(searcher.trials, trials, first.hypothesis)
    assert law.name in asked


def test_a_lag_beside_a_delay_that_explains_their_sum_is_found():
    delay, lag = InputDelay("torque"), ActuatorLag("torque")
    searcher = searcher_of(LATE, (1.25, 0.76), lag)
    late = searcher.trials.refitted(searcher.fit_base(), (delay,))
    candidates = searcher.look(late).ranking
    found = fit_shortlist(searcher.trials, late, candidates)["torque.actuator_lag"]
    true = dict(
        make_case("pendulum", "two_at_one_place", LATE, strength=(1.25, 0.76), seed=2001)
        .truth[1]
        .parameters
    )["time_constant"]
    # The linear estimate leads to a local minimum at a tenth of it.
    assert float(found.parameters["torque.actuator_lag.time_constant"]) == pytest.approx(
        true, rel=0.5
    )
