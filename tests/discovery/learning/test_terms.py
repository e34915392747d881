"""Every term is the same law along the recorded motion and in the file of the learned effect."""

import re
from dataclasses import replace

import pytest
import torch

from npdr_ppl.discovery.learning.effect_source import module_source
from npdr_ppl.discovery.learning.formulas import effects_of
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.terms import terms_at, with_harmonics
from npdr_ppl.language.channels import Port
from npdr_ppl.language.effect_context import Joint, Start
from tests.helpers.port_motions import COMMAND, JOINT, SENSOR


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


def law_with(motion, term):
    num = len(term.columns)
    coefficients = tuple(0.3 + 0.1 * k for k in range(num))
    ranges = {name: (float(x.min()), float(x.max())) for name, x in motion.values.items()}
    spreads = (1.0,) * num
    return Law(
        motion.port, (term,), coefficients, spreads, ranges, motion.units, others=motion.others
    )


def waves_with_harmonics(motion):
    return [more for term in terms_at(motion) if (more := with_harmonics(term)) is not None]


@pytest.mark.parametrize("extra", [terms_at, waves_with_harmonics])
def test_a_force_is_the_same_in_the_file_as_along_the_motion(extra):
    for term in extra(JOINT):
        if term.memory is not None:
            continue
        law = law_with(JOINT, term)
        (effect,), values = effects_of([law])
        parameters = {name.rpartition(".")[2]: value for name, value in values.items()}
        x = {name: value.flatten() for name, value in JOINT.values.items()}
        memory = None
        if law.uses & {"t", "tau", "q_1", "v_1"}:
            start = Start(x["t"] - 0.005, 0.01, parameters)
            memory = effect.initial_memory(x["q"], x["v"], start)
            others = {"elbow": (x["q_1"], x["v_1"])}
            joint = Joint(x["q"], x["v"], x["q"], x["q"], x["tau"], others=others)
            if effect.needs_joint:
                memory = effect.begin_step(joint, parameters, memory, 0.01)
        expected = (term.values(JOINT) * torch.tensor(law.coefficients)).sum(-1).flatten()
        if term.is_dry:
            bound = effect.dry_friction(x["q"], x["v"], parameters, memory)
            expected = -(-expected * x["v"].sign()).relu() * x["v"].sign()
            found = -bound * x["v"].sign()
        else:
            found = effect.force(x["q"], x["v"], parameters, memory)
        assert torch.allclose(found, expected, rtol=1e-4, atol=1e-5), term.key


def test_a_command_is_changed_in_the_file_as_along_the_motion():
    class Present:
        def __init__(self, command):
            self.command = command

        def now(self):
            return self.command

    for term in terms_at(COMMAND):
        if term.memory is not None:
            continue
        law = law_with(COMMAND, term)
        (effect,), values = effects_of([law])
        parameters = {name.rpartition(".")[2]: value for name, value in values.items()}
        u, t = (COMMAND.values[name].flatten() for name in ("u", "t"))
        memory = effect.initial_memory(u, Start(t - 0.005, 0.01, parameters))
        found, later = effect.act(Present(u), parameters, memory, 0.01)
        expected = (term.values(COMMAND) * torch.tensor(law.coefficients)).sum(-1).flatten()
        assert torch.allclose(found - u, expected, rtol=1e-4, atol=1e-5), term.key
        assert later is None or torch.allclose(later["t"], t + 0.01)


def test_a_sensor_reads_in_the_file_what_the_term_says():
    for term in terms_at(SENSOR):
        law = law_with(SENSOR, term)
        (effect,), values = effects_of([law])
        parameters = {name.rpartition(".")[2]: value for name, value in values.items()}
        y = SENSOR.values["y"].flatten()
        found, _ = effect.read(y, parameters, None, 0.01)
        expected = (term.values(SENSOR) * torch.tensor(law.coefficients)).sum(-1).flatten()
        assert torch.allclose(found - y, expected, rtol=1e-4, atol=1e-5), term.key


def test_a_segment_starts_with_the_velocity_that_the_sensors_error_hides():
    for term in terms_at(SENSOR):
        law = law_with(SENSOR, term)
        # Small errors, as of sensors.
        law = replace(law, coefficients=tuple(0.03 * c for c in law.coefficients))
        (effect,), values = effects_of([law])
        parameters = {name.rpartition(".")[2]: value for name, value in values.items()}
        # Not at the ends of splines, where the slope jumps.
        y = (0.99 * SENSOR.values["y"].flatten()).requires_grad_()
        reading, _ = effect.read(y, parameters, None, 0.01)
        (slope,) = torch.autograd.grad(reading.sum(), y)
        rate = effect.initial_rate(0.7 * slope, y.detach(), parameters)
        assert torch.allclose(rate, torch.full_like(rate, 0.7), rtol=1e-6), term.key


def test_terms_have_unique_names_and_costs_that_count_their_columns():
    for motion in (JOINT, COMMAND, SENSOR):
        terms = terms_at(motion)
        assert len({term.key for term in terms}) == len(terms)
        assert all(term.cost >= len(term.columns) for term in terms)


@pytest.mark.parametrize("motion", [JOINT, COMMAND, SENSOR])
def test_a_coefficient_multiplies_the_whole_formula_behind_it(motion):
    for term in terms_at(motion):
        for formula in () if term.is_spline else term.formulas:
            outside, depth = "", 0
            for letter in formula:
                depth += (letter == "(") - (letter == ")")
                outside += letter if depth == 0 else ""
            assert not re.search(" [+−] ", outside), formula


def test_a_file_says_the_law_its_units_and_where_it_was_learned():
    term = next(t for t in terms_at(JOINT) if t.key == "v³")
    source = module_source([law_with(JOINT, term)], "From a test.")
    assert "LearnedHinge at hinge: 0.3 v³" in source
    assert '"N m/(rad/s)³"' in source
    assert "It was learned for v from" in source
    assert "From a test." in source


@pytest.mark.parametrize(
    "name", ['a"""; raise SystemExit; """', "a\\", "x²", 'a"\nraise SystemExit\n"']
)
def test_the_name_of_a_port_does_not_become_code(name):
    term = next(t for t in terms_at(JOINT) if t.key == "v")
    law = replace(law_with(JOINT, term), port=Port(name, "force", 'N"m'))
    (effect,), _ = effects_of([law])
    assert effect.port == name and effect.parameters[0].unit.startswith('N"m')
    compile(module_source([law], f"Of {name}."), "learned_effect.py", "exec")


def test_laws_at_two_ports_are_two_classes_of_one_file():
    term = next(t for t in terms_at(JOINT) if t.key == "v")
    law = law_with(JOINT, term)
    other = replace(law, port=Port("second joint", "force", "N m"))
    effects, _ = effects_of([law, other])
    assert effects[0].id == "learned_hinge"
    assert effects[1].id.startswith("learned_second_joint_")


def test_ports_whose_names_differ_only_in_signs_have_their_own_laws():
    terms = {term.key: term for term in terms_at(JOINT)}
    names = ("left_knee", "left-knee", "left knee", "Left_Knee", "leftKnee", "joint²", "1")
    keys = ("1", "q", "v", "v²", "v³", "q²", "q³")
    laws = [
        replace(law_with(JOINT, terms[key]), port=Port(name, "force", "N m"))
        for name, key in zip(names, keys, strict=True)
    ]
    effects, _ = effects_of(laws)
    assert [effect.law for effect in effects] == [law.formula for law in laws]
    assert len({effect.id for effect in effects}) == len(names)


@pytest.mark.parametrize("end", ['"""', "\\", '\\"""', "\\N"])
def test_names_and_units_of_a_robot_do_not_become_code(end):
    name = f'hinge{end}\nraise SystemExit("ran")\n{end}'
    term = next(t for t in terms_at(JOINT) if t.key == "v")
    law = replace(law_with(JOINT, term), port=Port(name, "force", f'N m"{end}'))
    law = replace(law, units={**law.units, "v": f"rad/s{end}\nraise SystemExit\n"})
    (effect,), _ = effects_of([law])
    assert effect.port == name
    assert effect.parameters[0].unit.startswith(f'N m"{end}')


@pytest.mark.parametrize("motion", [JOINT, COMMAND, SENSOR])
def test_numbers_take_the_place_of_all_letters_of_constants(motion):
    for term in [*terms_at(motion), *waves_with_harmonics(motion)]:
        text = law_with(motion, term).formula_with_numbers
        assert not set(re.findall(r"\w+", text)) & {"k", "vₛ", "e", "T"}, text


def test_a_law_has_another_name_than_effects_that_are_known():
    law = law_with(JOINT, next(t for t in terms_at(JOINT) if t.key == "v"))
    assert law.apart_from(set()).id == "learned_hinge"
    other = law.apart_from({"learned_hinge", "learned_hinge__2"})
    effects, _ = effects_of([law, other])
    assert [effect.id for effect in effects] == ["learned_hinge", "learned_hinge__3"]


@pytest.mark.parametrize("end", ["", '"]; raise SystemExit("ran")\n"""', "\\"])
def test_a_law_that_depends_on_another_joint_names_it(end):
    term = next(t for t in terms_at(JOINT) if t.key == "q₁ · v")
    name = f"elbow{end}"
    law = replace(law_with(JOINT, term), others=(name,))
    assert law.formula == "c₁ q₁ · v" and law.letters == {"q₁": f"the position at {name}"}
    (effect,), values = effects_of([law])  # the name does not become code
    joint = Joint(*tensor([1.0, 2.0, 0.0, 0.0, 0.0]), others={name: tensor([0.3, 0.0]).unbind()})
    memory = effect.initial_memory(joint.position, joint.velocity, Start(tensor(0.0), 0.1, {}))
    memory = effect.begin_step(joint, {}, memory, 0.1)
    given = {"c1": tensor(0.5)}
    found = effect.force(joint.position, joint.velocity, given, memory)
    assert float(found) == pytest.approx(0.5 * 0.3 * 2.0)
    source = module_source([law], "From a test.")
    assert "q₁ is the position at elbow" in source and 'joint.others["elbow' in source
