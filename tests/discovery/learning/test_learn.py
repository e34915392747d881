"""Laws that are in no catalogue, learned from recordings that other equations made."""

from dataclasses import replace

import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery import Investigation
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.learning.learn import learned_model
from npdr_ppl.discovery.learning.proof import checks
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.discovery.segment_options import short_segments
from npdr_ppl.language.handlers import add_effect
from npdr_ppl.models.effects import CoulombFriction, QuadraticDrag
from npdr_ppl.models.pendulum import pendulum
from tests.helpers.pendulum_recordings import swinging


def learned_from(place, strength, rig="pendulum", condition="outside", rollouts=None):
    """The truth, the law learned of some of a case's rollouts or all, and how it was checked."""
    case = make_case(rig, condition, (place,), strength=strength, seed=2001)
    fit = case.fit if rollouts is None else case.fit[rollouts]
    start = fit_hypothesis(case.model, fit, short_segments(fit))
    model = learned_model(Trials(start.segments), start)
    assert model is not None
    (law,) = model.laws
    found = checks(model, case.holdout, short_segments(case.holdout))
    return case.truth[0].parameters, law, found


@pytest.mark.slow
def test_cubic_damping_is_learned_with_its_coefficient():
    true, law, found = learned_from(("hinge", "cubic_damping"), 1.0, rollouts=[0])
    assert [term.key for term in law.terms] == ["v³"]
    assert law.coefficients[0] == pytest.approx(-true["damping"], rel=0.1)
    assert all(check.helps for check in found)


@pytest.mark.slow
def test_friction_that_depends_on_the_position_is_learned():
    true, law, found = learned_from(("hinge", "position_dependent_friction"), 2.0)
    assert law.uses == {"q", "v"}
    assert all(term.is_dry for term in law.terms)
    (number,) = [shape.value for term in law.terms for shape in term.shapes]
    assert number == pytest.approx(true["wave_number"], rel=0.05)
    assert all(check.helps for check in found)


@pytest.mark.slow
def test_an_error_of_a_sensor_is_learned_at_the_sensor():
    true, law, found = learned_from(("angle", "eccentric_encoder"), 0.3, rollouts=[0, 1])
    assert law.port.name == "angle"
    assert float(torch.tensor(law.coefficients).norm()) == pytest.approx(
        true["amplitude"], rel=0.3
    )
    assert all(check.helps for check in found)


@pytest.mark.slow
def test_a_command_that_is_stronger_one_way_is_learned_as_a_function_of_the_command():
    true, law, _ = learned_from(("torque", "asymmetric_gain"), 2.0, rollouts=[0])
    assert law.formula.endswith(("|u|", "|τ|"))
    assert law.coefficients[0] == pytest.approx(true["difference"], rel=0.15)


@pytest.mark.slow
def test_no_law_is_learned_where_nothing_is_missing(quiet):
    assert learned_model(Trials(quiet.segments), quiet) is None


@pytest.mark.slow
def test_a_discovery_writes_the_learned_effect_and_a_model_that_has_it(tmp_path):
    case = make_case("pendulum", "outside", (("hinge", "cubic_damping"),), strength=3.0, seed=2001)
    search = npdr.DiscoveryOptions(effects=(), learn=True)
    fit, holdout = case.fit[[0, 1]], case.holdout[[0]]
    found = npdr.discover(case.model, fit, holdout=holdout, search=search)
    assert found.verdict == "learned"
    assert found.gap["rmse"].after < found.gap["rmse"].before
    found.save(tmp_path)
    space = {"__name__": "own_effects"}
    exec((tmp_path / "learned_effect.py").read_text(), space)
    effect = space["LearnedHinge"]("hinge")
    revised = add_effect(case.model, effect)
    before, after = (fit_hypothesis(m, fit, short_segments(fit)) for m in (case.model, revised))
    assert float(after.fit.scale.log().sum()) < float(before.fit.scale.log().sum())
    assert "class LearnedHinge(ForceEffect):" in (tmp_path / "revised_model.py").read_text()


@pytest.mark.slow
def test_what_the_catalogue_names_is_not_learned():
    place = ("hinge", "quadratic_drag")
    case = make_case("pendulum", "one", (place,), strength=1.0, seed=2001)
    search = npdr.DiscoveryOptions(effects=(QuadraticDrag("hinge"),), learn=True)
    found = npdr.discover(case.model, case.fit, search=search)
    assert (found.verdict, found.learned) == ("named", None)


@pytest.mark.slow
def test_hysteresis_is_learned_with_the_motion_before_each_segment():
    true, law, found = learned_from(("hinge", "bouc_wen_hysteresis"), 1.0, rollouts=[0])
    (term,) = (term for term in law.terms if term.memory is not None)
    assert term.memory is not None and term.memory.symbol == "bend"
    width = next(shape.value for shape in term.shapes if shape.name == "width")
    assert width == pytest.approx(true["deflection"], rel=0.5)
    assert all(check.helps for check in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("port", "effect", "symbol", "name"),
    [
        ("voltage", "input_delay", "late", "delay"),
        ("carriage", "joint_elasticity", "ring", "time_constant"),
    ],
)
def test_a_command_that_is_late_or_rings_is_learned_with_its_time(port, effect, symbol, name):
    true, law, found = learned_from(
        (port, effect), 0.5, rig="emps", condition="one", rollouts=[0, 1]
    )
    assert law.port.name == "voltage"
    (term,) = (t for t in law.terms if t.memory is not None and t.memory.symbol == symbol)
    value = next(shape.value for shape in term.shapes if shape.name == name)
    assert value == pytest.approx(true[name], rel=0.1)
    assert all(check.helps for check in found)


@pytest.mark.slow
def test_a_wave_in_time_is_learned_with_its_frequency():
    true, law, found = learned_from(
        ("hinge", "periodic_disturbance"), 1.0, rig="pendulum", condition="one", rollouts=[0]
    )
    (frequency,) = (s.value for t in law.terms for s in t.shapes if s.name == "frequency")
    assert frequency == pytest.approx(true["frequency"], rel=0.01)
    assert all(check.helps for check in found)


def test_a_model_with_effects_is_fitted_to_short_segments_too():
    options = npdr.DiscoveryOptions(effects=(CoulombFriction("hinge"),), repeat=False)
    investigation = Investigation(pendulum, swinging(friction=0.2), search=options)
    investigation._short_options = replace(investigation._data_options, segment_length=10)
    final = investigation.search.final
    found = investigation._in_short_segments(final)
    assert found.names == final.names == ("hinge.coulomb_friction",)
    assert found.segments.inputs.num_steps == 10
    friction = float(found.parameters["hinge.coulomb_friction.magnitude"])
    assert friction == pytest.approx(0.2, rel=0.15)
