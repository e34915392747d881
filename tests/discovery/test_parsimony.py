"""The fewest and simplest laws."""

import pyro.distributions as dist
import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.discovery.search.alternatives import (
    Alternatives,
    _strains,
    weigh_alternatives,
    with_simple_forms,
)
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.discovery.search.parsimony import lost_share, overlap, plausible_laws, simplest_laws
from npdr_ppl.models.effects import (
    Bias,
    CoulombFriction,
    FrictionDrift,
    PreslidingFriction,
    QuadraticDrag,
    Spring,
    StribeckFriction,
    ViscousFriction,
    Wind,
)
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.pendulum_recordings import swinging


@pytest.fixture(scope="module")
def rubbed():
    """A searcher of a recording with dry friction, and the fit of the model without it."""
    searcher = Searcher(pendulum, swinging(friction=0.2), npdr.DiscoveryOptions())
    return searcher, searcher.fit_base()


def fitted(searcher, *effects):
    return fit_hypothesis(pendulum, searcher.rollouts, searcher.data_options, effects=effects)


def simplest(searcher, base, current):
    candidates = candidates_at(base, searcher.options)
    found, _ = simplest_laws(base, current, candidates, searcher.trials)
    return found


def test_dry_friction_in_two_laws_becomes_one(rubbed):
    searcher, base = rubbed
    both = fitted(searcher, PreslidingFriction("hinge"), CoulombFriction("hinge"))
    found = simplest(searcher, base, both)
    assert found.names == ("hinge.coulomb_friction",)
    assert float(found.parameters["hinge.coulomb_friction.magnitude"]) == pytest.approx(
        0.2, rel=0.1
    )
    assert lost_share(base, both, found) < 0.1


def test_a_simple_law_is_fitted_again_where_one_that_contains_it_fits_better(rubbed):
    searcher, base = rubbed
    drift, dry = FrictionDrift("hinge"), CoulombFriction("hinge")
    stuck = fit_hypothesis(
        pendulum,
        searcher.rollouts,
        searcher.data_options,
        effects=(dry,),
        start=base.parameters | {f"{dry.name}.magnitude": torch.tensor(0.02)},
        max_steps=0,
    )
    known = Alternatives(base, fitted(searcher, drift), {dry.name: stuck})
    found = with_simple_forms(drift, known, searcher.trials)
    assert found.with_it is known.with_it and found.without is base
    again = found.others[dry.name]
    assert float(again.parameters[f"{dry.name}.magnitude"]) == pytest.approx(0.2, rel=0.1)
    # Once it fits as well, nothing is fitted.
    assert with_simple_forms(drift, found, None) is found
    # The model that was asked about is replaced by the better fit, unless the time is over.
    asked = Alternatives(base, stuck, {drift.name: known.with_it})
    better = with_simple_forms(dry, asked, searcher.trials)
    chosen, added = weigh_alternatives(base, stuck, dry, better)
    assert better.is_better and chosen is better.with_it and added.effect.name == dry.name
    assert with_simple_forms(dry, asked, None, lambda: True) is asked


@pytest.mark.parametrize(("friction", "counts"), [(0.25, True), (0.2, False)])
def test_a_law_counts_for_the_simple_law_in_it_unless_it_fits_better(friction, counts):
    # By chance, friction that drifts fits the second recording better by 2.9 nats.
    searcher = Searcher(pendulum, swinging(friction=friction), npdr.DiscoveryOptions())
    base, dry, drift = searcher.fit_base(), CoulombFriction("hinge"), FrictionDrift("hinge")
    with_dry, with_drift = fitted(searcher, dry), fitted(searcher, drift)
    found = Alternatives(base, with_dry, {drift.name: with_drift})
    _, added = weigh_alternatives(base, with_dry, dry, found)
    assert added.effect.name == dry.name
    assert added.forms == ((drift.name,) if counts else ())
    # What counts for it is no further cause.
    assert (drift.name in added.alternatives) is not counts
    expected = 1.0 if counts else added.alternatives[dry.name]
    assert added.probability == pytest.approx(expected)


@pytest.mark.parametrize("law", [PreslidingFriction, StribeckFriction, FrictionDrift])
def test_a_law_whose_shape_explains_nothing_takes_its_simplest_form(rubbed, law):
    searcher, base = rubbed
    found = simplest(searcher, base, fitted(searcher, law("hinge")))
    assert found.names == ("hinge.coulomb_friction",)


def plausible(searcher, base, current, most=5):
    candidates = candidates_at(base, searcher.options)
    return plausible_laws(current, candidates, searcher.trials, most=most)


def test_a_drift_whose_time_the_recording_does_not_tell_is_friction(rubbed):
    searcher, base = rubbed
    found = plausible(searcher, base, fitted(searcher, FrictionDrift("hinge")))
    assert found.names == ("hinge.coulomb_friction",)
    friction = fitted(searcher, CoulombFriction("hinge"))
    assert plausible(searcher, base, friction) is friction


@pytest.mark.parametrize(
    ("hidden", "law", "expected"),
    [
        (
            ("coulomb_friction", "viscous_friction"),
            FrictionDrift,
            {"hinge.coulomb_friction", "hinge.viscous_friction"},
        ),
        (("spring", "bias"), Spring, {"hinge.spring", "hinge.bias"}),
    ],
)
def test_a_law_with_an_unknown_shape_becomes_a_pair(hidden, law, expected):
    places = tuple(("hinge", effect) for effect in hidden)
    strength = (0.1, 1.0) if law is Spring else (0.3, 0.3)
    case = make_case("pendulum", "two_at_one_place", places, strength=strength, seed=2001)
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions())
    base = searcher.fit_base()
    current = searcher.trials.refitted(base, (law("hinge"),))
    assert set(plausible(searcher, base, current).names) == expected
    assert plausible(searcher, base, current, most=1) is current


def test_an_effect_that_explains_much_stays(rubbed):
    searcher, base = rubbed
    single = fitted(searcher, CoulombFriction("hinge"))
    assert simplest(searcher, base, single) is single


def test_an_effect_that_explains_nothing_goes(rubbed):
    searcher, base = rubbed
    both = fitted(searcher, CoulombFriction("hinge"), Bias("hinge"))
    assert simplest(searcher, base, both).names == ("hinge.coulomb_friction",)


def test_forms_of_one_law_overlap_at_the_same_port():
    assert overlap(PreslidingFriction("arm"), CoulombFriction("arm"))
    assert overlap(CoulombFriction("arm"), PreslidingFriction("arm"))
    assert overlap(FrictionDrift("arm"), ViscousFriction("arm"))
    assert overlap(Wind("arm"), QuadraticDrag("arm"))
    assert not overlap(PreslidingFriction("arm"), CoulombFriction("pole"))
    # Friction that is greater at rest is attached beside dry friction.
    assert not overlap(StribeckFriction("arm"), CoulombFriction("arm"))
    assert not overlap(QuadraticDrag("arm"), CoulombFriction("arm"))


def test_an_approximate_model_wants_simple_laws_that_do_not_overlap(rubbed):
    searcher, base = rubbed
    names = {
        law.id: fitted(searcher, law("hinge"))
        for law in (CoulombFriction, PreslidingFriction, QuadraticDrag)
    }
    trials = {f"hinge.{name}": found for name, found in names.items()}
    exact = dict(zip(trials, _strains(trials, base, False), strict=True))
    approximate = dict(zip(trials, _strains(trials, base, True), strict=True))
    assert exact["hinge.coulomb_friction"] == approximate["hinge.coulomb_friction"] == 0.0
    assert approximate["hinge.presliding_friction"] > 5.0 * exact["hinge.presliding_friction"]
    assert approximate["hinge.quadratic_drag"] == exact["hinge.quadratic_drag"]
    both = fitted(searcher, CoulombFriction("hinge"), PreslidingFriction("hinge"))
    (beside,) = _strains({"hinge.presliding_friction": both}, base, True)
    assert beside > 5.0 * approximate["hinge.presliding_friction"]


def test_a_law_with_an_implausible_shape_takes_its_simplest_form(rubbed):
    # Friction that fades within 1e4 rad/s fades nowhere in this recording.
    searcher, base = rubbed
    priors = {"speed": dist.LogNormal(-2.3, 0.8)}
    found = fitted(searcher, StribeckFriction("hinge", priors=priors))
    assert found.at_edge(found.effects[0]) == ("speed",)
    assert simplest(searcher, base, found).names == ("hinge.coulomb_friction",)


@pytest.mark.slow
def test_a_simple_form_can_be_left_out_in_turn(dragged):
    # Drag explains all, so a drift becomes one of its simple forms, by chance, and that one goes.
    case, _ = dragged
    searcher = Searcher(case.model, case.fit, npdr.DiscoveryOptions())
    base, told = searcher.fit_base(), []
    both = fit_hypothesis(
        case.model,
        case.fit,
        searcher.data_options,
        effects=(QuadraticDrag("hinge"), FrictionDrift("hinge")),
    )
    candidates = candidates_at(base, searcher.options)
    found, minor = simplest_laws(base, both, candidates, searcher.trials, told.append)
    assert found.names == ("hinge.quadratic_drag",) and not minor
    drift, simple = (line.split()[0] for line in told)
    assert drift == "hinge.friction_drift"
    assert simple in ("hinge.viscous_friction", "hinge.coulomb_friction")
