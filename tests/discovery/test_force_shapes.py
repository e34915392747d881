"""The shape of a force's law, found from the recording."""

import math
from dataclasses import replace

import pytest
import torch
from hidden_rigs import make_case

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.force_shapes import force_shape
from npdr_ppl.discovery.screening.latent_force import responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import PulseChanges
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.screening.sensitivities import sensitivities
from npdr_ppl.discovery.screening.variants import variants_of
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import Bias, Spring, StribeckFriction, Wind


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


class Ratchet(Spring):
    """A spring that is stiffer in one direction."""

    id = "ratchet"

    def columns(self, position, velocity):
        return tuple(
            torch.where(velocity > 0.0, 2.0, 1.0) * c for c in super().columns(position, velocity)
        )


def test_only_laws_of_a_measured_position_have_a_shape(sprung):
    _, projection, found = sprung
    assert set(force_shape(projection, found, Spring("rail"))) == {"rest"}
    assert force_shape(projection, found, Bias("rail")) == {}
    assert force_shape(projection, found, Ratchet("rail")) == {}
    assert force_shape(projection, replace(found, positions={}), Spring("rail")) == {}


def test_a_spring_that_would_push_away_has_no_shape(sprung):
    _, projection, found = sprung
    turned = replace(found, by_port={port: -change for port, change in found.by_port.items()})
    assert force_shape(projection, turned, Spring("rail")) == {}


def test_a_shape_that_the_recording_does_not_determine_is_not_tried(sprung):
    _, projection, found = sprung
    still = {name: torch.ones_like(value) for name, value in found.channels.items()}
    assert force_shape(projection, replace(found, channels=still), Spring("rail")) == {}


@pytest.fixture(scope="module")
def windy():
    case = make_case("pendulum", "one", [("hinge", "wind")], strength=0.3, seed=2002)
    fitted = fit_hypothesis(case.model, case.fit, segment_options(case.fit))
    return case, Projection(fitted), responses(fitted)


def test_wind_is_tried_in_the_direction_that_explains_most(windy):
    case, projection, found = windy
    effects = (Wind("hinge"),)
    (few,) = screen(projection, sensitivities(projection.hypothesis, effects))
    (best,) = screen(projection, variants_of(effects, projection, found))
    assert best.variant.is_hinted
    assert best.gain > few.gain
    difference = best.variant.values["direction"] - case.truth[0].parameters["direction"]
    assert abs(math.remainder(difference, 2.0 * math.pi)) < math.pi / 4.0


def test_rates_that_are_not_measured_follow_from_the_positions(windy):
    _, projection, found = windy
    measured = force_shape(projection, found, Wind("hinge"))
    position = found.positions["hinge"]
    renamed = {**found.channels, "angle": found.channels[position]}
    unmeasured = replace(found, channels=renamed, positions={"hinge": "angle"})
    difference = force_shape(projection, unmeasured, Wind("hinge"))["direction"]
    difference -= measured["direction"]
    assert abs(math.remainder(difference, 2.0 * math.pi)) < math.pi / 4.0


class Gust(Wind):
    """Wind that only ever pushes towards negative positions."""

    id = "gust"

    def force(self, position, velocity, parameters, memory):
        return -parameters["force"] * torch.ones_like(position * parameters["speed"])


def test_shapes_of_which_none_explains_anything_are_not_tried(windy):
    _, projection, found = windy
    pushed = found.by_port["hinge"]
    ones = torch.ones(*pushed.shape[::2], 1, dtype=torch.float64)
    sign = float(PulseChanges(projection, pushed).scores(ones).score.sign())
    turned = replace(found, by_port={"hinge": sign * pushed})
    assert force_shape(projection, turned, Gust("hinge")) == {}


def test_laws_with_dry_friction_have_no_shape(windy):
    _, projection, found = windy
    assert force_shape(projection, found, StribeckFriction("hinge")) == {}
