"""Ripples over a joint's angle: the number per turn is found from the recording."""

import numpy as np
import pytest
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.screening.generic_laws import strongest_ripple
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.models.effects import Cogging


@pytest.fixture(scope="module")
def case():
    return make_case("pendulum", "one", (("hinge", "cogging"),), strength=2.0, seed=3)


def test_the_number_per_turn_is_the_hidden_one(case):
    options = npdr.DiscoveryOptions(effects=(Cogging("hinge"),))
    fitted = Searcher(case.model, case.fit, options).fit_base()
    found = responses(fitted)
    assert found.positions == {"hinge": "angle"}
    (hidden,) = case.truth
    assert strongest_ripple(Projection(fitted), found, "hinge") == hidden.parameters["order"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "positions"),
    [
        ("furuta", {"arm": "arm_angle", "pole": "pole_angle"}),
        # A torque at the shoulder moves the elbow's angle more than the shoulder's.
        ("two_link_arm", {"shoulder": "shoulder_angle", "elbow": "elbow_angle"}),
    ],
)
def test_each_port_has_the_position_of_its_own_joint(rig, positions):
    made = make_case(rig, "null", (), seed=3)
    searcher = Searcher(made.model, made.fit, npdr.DiscoveryOptions())
    assert responses(searcher.fit_base(may_be_rough=True)).positions == positions


@pytest.mark.slow
def test_cogging_is_named_with_its_number_per_turn(case):
    options = npdr.DiscoveryOptions(effects=(Cogging("hinge"),))
    found = npdr.discover(case.model, case.fit, search=options, seed=0)
    (effect,) = found.effects
    (hidden,) = case.truth
    assert effect.to_dict()["constants"] == {"order": hidden.parameters["order"]}
    amplitude = np.hypot(*(effect.parameters[name].mean for name in ("sine", "cosine")))
    true = np.hypot(hidden.parameters["sine"], hidden.parameters["cosine"])
    assert amplitude == pytest.approx(true, rel=0.1)
    assert "order=" in npdr.discovery.revised_model.revised_source(
        case.model, (effect.effect,), {}
    )


@pytest.mark.slow
def test_a_known_number_per_turn_is_kept(case):
    options = npdr.DiscoveryOptions(effects=(Cogging("hinge", order=5),))
    searcher = Searcher(case.model, case.fit, options)
    ranking = searcher.look(searcher.fit_base()).ranking
    assert ranking
    assert all(candidate.variant.effect.order == 5 for candidate in ranking)
