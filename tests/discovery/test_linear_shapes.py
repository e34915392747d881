"""The shape of a law that is linear in other parameters."""

import pytest
from hidden_rigs import make_case

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.linear_shapes import linear_shape
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.screening.sensitivities import sensitivities
from npdr_ppl.discovery.screening.variants import variants_of
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import Bias, QuadraticDrag, Spring


@pytest.fixture(scope="module")
def sprung():
    hidden = [("rail", "spring")]
    case = make_case("cart_pole", "one", hidden, strength=0.3, seed=2002)
    fitted = fit_hypothesis(case.model, case.fit, segment_options(case.fit))
    return case, Projection(fitted), responses(fitted)


def test_a_spring_is_tried_at_the_rest_position_that_explains_most(sprung):
    case, projection, found = sprung
    effects = (Spring("rail"),)
    (few,) = screen(projection, sensitivities(projection.hypothesis, effects))
    (best,) = screen(projection, variants_of(effects, projection, found))
    assert best.variant.is_hinted
    assert best.gain > few.gain
    span = projection.hypothesis.simulator.port("rail").rated_position
    truth = case.truth[0].parameters["rest"]
    assert best.variant.values["rest"] == pytest.approx(truth, abs=0.1 * span)


def test_only_laws_of_the_position_with_a_shape_have_one(sprung):
    _, projection, found = sprung
    assert linear_shape(projection, found, Bias("rail")) == {}
    assert linear_shape(projection, found, QuadraticDrag("rail")) == {}


def test_a_spring_that_would_push_away_has_no_shape(sprung):
    _, projection, found = sprung
    assert set(linear_shape(projection, found, Spring("rail"))) == {"rest"}
    turned = Projection(projection.hypothesis)
    turned.residual = -projection.residual
    turned._weighted = -projection._weighted
    turned._score = -projection._score
    assert linear_shape(turned, found, Spring("rail")) == {}
