"""Laws that are symmetric or passive, because the user knows it."""

import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.learning.assumptions import Assumptions
from npdr_ppl.discovery.learning.curves import law_along
from npdr_ppl.discovery.learning.learn import learned_model
from npdr_ppl.discovery.learning.recorded_motion import motion_at_ports
from npdr_ppl.discovery.learning.regression import Formula
from npdr_ppl.discovery.learning.terms import terms_at
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.segment_options import short_segments
from npdr_ppl.errors import DataError
from tests.helpers.port_motions import COMMAND, JOINT


def keys(assumptions, motion=JOINT):
    return {term.key for term in assumptions.applied_to(terms_at(motion), motion)}


def test_nothing_is_left_out_without_assumptions():
    assert keys(Assumptions()) == {term.key for term in terms_at(JOINT)}


def test_an_odd_law_has_odd_terms_and_only_the_odd_one_of_sine_and_cosine():
    odd = keys(Assumptions("odd"))
    assert {"v", "v³", "q", "sign v", "sin q", "cos q · v"} <= odd
    assert not odd & {"1", "v²", "q²", "cos q", "sin q + cos q", "q · v", "q · sign v"}


def test_an_even_law_has_the_others():
    even = keys(Assumptions("even"))
    assert {"1", "v²", "q · v", "cos q", "q · sign v"} <= even
    assert not even & {"v", "sign v", "q", "sin q"}


def test_a_passive_law_only_brakes():
    passive = Assumptions(is_passive=True)
    allowed = keys(passive)
    assert {"v", "v|v|", "sign v", "q² · v"} <= allowed
    assert not allowed & {"q", "1", "v²", "τ", "q · v"}
    assert keys(passive, COMMAND) == set()
    term = next(term for term in terms_at(JOINT) if term.key == "v")
    for sign, agrees in ((-1.0, True), (1.0, False)):
        coefficients = torch.tensor([sign], dtype=torch.float64)
        formula = Formula((term,), coefficients, torch.zeros(2), 0.0)
        assert passive.agrees(formula, JOINT) is agrees


@pytest.mark.slow
def test_a_passive_law_is_learned_of_friction_that_depends_on_the_position():
    place = ("hinge", "position_dependent_friction")
    case = make_case("pendulum", "outside", (place,), strength=2.0, seed=2001)
    start = fit_hypothesis(case.model, case.fit, short_segments(case.fit))
    assumptions = Assumptions(is_passive=True)
    model = learned_model(Trials(start.segments), start, assumptions=assumptions)
    assert model is not None
    (law,) = model.laws
    motion = next(m for m in motion_at_ports(start) if m.port.name == "hinge")
    force = law_along(law, motion)
    assert float(force.square().mean()) > 0.0
    assert float((force * motion.values["v"]).max()) <= 0.0


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"learn": True, "symmetry": "skew"}, "symmetry is 'odd', 'even' or None"),
        ({"symmetry": "odd"}, "set learn=True"),
        ({"is_passive": True}, "set learn=True"),
    ],
)
def test_assumptions_about_no_law_are_refused(wrong, sentence):
    with pytest.raises(DataError, match=sentence):
        npdr.DiscoveryOptions(**wrong)
