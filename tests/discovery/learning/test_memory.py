"""Laws that remember: the same in the file as along the motion, and what they remember."""

import math
from dataclasses import replace

import pytest
import torch
from hidden_rigs import make_case, under_test

from npdr_ppl.cli.effect_words import named_effects
from npdr_ppl.discovery.learning.effect_source import module_source
from npdr_ppl.discovery.learning.expressions import (
    bent,
    bent_unevenly,
    mean_ringing,
    relaxed,
    ringing,
)
from npdr_ppl.discovery.learning.formulas import effects_of
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.terms import terms_at
from npdr_ppl.discovery.learning.terms_with_memory import series_at
from npdr_ppl.engines.common.commands import RecentCommands
from npdr_ppl.language.effect_context import Start
from tests.helpers.port_motions import COMMAND, JOINT

STEP = JOINT.time_step


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


def remembering(motion):
    every = [*terms_at(motion), *series_at(motion)]
    return [term for term in every if term.memory is not None]


def law_with(motion, *terms):
    num = sum(len(term.columns) for term in terms)
    coefficients = tuple(0.3 + 0.1 * k for k in range(num))
    ranges = {name: (float(x.min()), float(x.max())) for name, x in motion.values.items()}
    return Law(motion.port, terms, coefficients, (1.0,) * num, ranges, motion.units)


def expected(law, motion):
    columns = torch.cat([term.values(motion) for term in law.terms], dim=-1)
    return columns @ torch.tensor(law.coefficients, dtype=torch.float64)


def made(law):
    (effect,), values = effects_of([law])
    return effect, {name.rpartition(".")[2]: value for name, value in values.items()}


def forces(law, motion):
    """Forces of the effect's file, step by step, in the middle of each step."""
    effect, parameters = made(law)
    q, v = motion.values["q"], motion.values["v"]
    start = Start(
        motion.values["t"][:, 0] - 0.5 * STEP,
        STEP,
        parameters,
        displacements=motion.past.unbind(1),
        interval=motion.interval,
    )
    memory = effect.initial_memory(q[:, 0], v[:, 0], start)
    found = []
    for k in range(q.shape[1]):
        place = q[:, k] + 0.5 * STEP * v[:, k]
        found.append(effect.force(place, v[:, k], parameters, memory))
        memory = effect.next_memory(place, v[:, k], parameters, memory, STEP)
    return torch.stack(found, dim=1)


def test_forces_that_remember_are_the_same_in_the_file_as_along_the_motion():
    terms = remembering(JOINT)
    assert {term.memory.symbol for term in terms} == {"bend", "stretch"}
    for term in terms:
        law = law_with(JOINT, term)
        assert torch.allclose(forces(law, JOINT), expected(law, JOINT), rtol=1e-4, atol=1e-4)


def test_a_law_may_have_several_states():
    terms = {term.memory.symbol: term for term in remembering(JOINT)}
    law = law_with(JOINT, terms["bend"], terms["stretch"])
    assert torch.allclose(forces(law, JOINT), expected(law, JOINT), rtol=1e-4, atol=1e-4)
    assert "b₁" in law.formula and "r₂'" in law.formula_with_numbers
    assert set(law.letters) == {"b₁", "r₂"}


def test_commands_that_remember_are_the_same_in_the_file_as_along_the_commands():
    terms = remembering(COMMAND)
    assert {term.memory.symbol for term in terms} == {"output", "ring", "late"}
    every = torch.cat((COMMAND.past, COMMAND.values["u"]), dim=1)
    num = COMMAND.past.shape[1]
    for term in terms:
        law = law_with(COMMAND, term)
        effect, parameters = made(law)
        memory = effect.initial_memory(every[:, 0], Start(torch.zeros(2), STEP, parameters))
        past = [every[:, 0]] * 20
        found = []
        for command in every.unbind(1):
            seen = RecentCommands(command, tuple(past))
            changed, memory = effect.act(seen, parameters, memory, STEP)
            found.append(changed - command)
            past = [command, *past[:-1]]
        changes = torch.stack(found[num:], dim=1)
        assert torch.allclose(changes, expected(law, COMMAND), rtol=1e-4, atol=1e-4), term.key
        if term.memory.symbol == "late":
            delay = float(parameters["delay"])
            assert effect.history(parameters, STEP) == math.floor(delay / STEP) + 2


def test_the_bend_settles_at_the_side_of_a_long_motion_and_keeps_still_at_rest():
    bend = torch.tensor([-0.8, 0.0, 0.5], dtype=torch.float64)
    for function, more in ((bent, ()), (bent_unevenly, (tensor(0.4),))):
        assert torch.allclose(
            function(bend, torch.tensor(50.0), tensor(1.0), *more), torch.ones(3).double()
        )
        assert torch.equal(function(bend, torch.tensor(0.0), tensor(1.0), *more), bend)


def test_the_bend_of_one_motion_is_that_of_its_parts():
    bend = torch.linspace(-0.95, 0.95, 9, dtype=torch.float64)
    for function, more in ((bent, ()), (bent_unevenly, (tensor(0.4),))):
        for moved in (0.3, -0.7, 2.0):
            whole = function(bend, torch.tensor(moved), tensor(0.5), *more)
            parts = bend
            for _ in range(7):
                parts = function(parts, torch.tensor(moved / 7.0), tensor(0.5), *more)
            assert torch.allclose(whole, parts, atol=1e-9)


def test_an_uneven_bend_follows_its_equation():
    width, beta, bend, step = 0.5, 0.4, -0.7, 1e-5
    exact = float(
        bent_unevenly(torch.tensor(bend).double(), torch.tensor(0.6), tensor(width), tensor(beta))
    )
    for _ in range(60_000):
        sign = 1.0 if bend > 0.0 else -1.0
        bend += step * (1.0 - (1.0 - beta + beta * sign) * bend) / width
    assert exact == pytest.approx(bend, abs=1e-4)


def test_a_relaxed_spring_carries_a_steady_motion_as_a_damper():
    stretch = torch.zeros(())
    for _ in range(400):
        stretch = relaxed(stretch, torch.tensor(0.02), 0.01, tensor(0.3))
    assert float(stretch) == pytest.approx(2.0 * 0.3, rel=1e-3)


def test_a_resonance_follows_its_equation_and_so_does_its_mean():
    time, damping, step, u = tensor(0.02), tensor(0.1), 1e-5, tensor(1.5)
    output, rate, total = 0.3, -20.0, 0.0
    ring = tensor(output), tensor(rate)
    for _ in range(2_000):
        rate += step * ((1.5 - output) / 0.02 - 2.0 * 0.1 * rate) / 0.02
        output += step * rate
        total += output / 2_000
    after = ringing(ring, u, 0.02, time, damping)
    assert float(after[0]) == pytest.approx(output, abs=2e-3)
    assert float(after[1]) == pytest.approx(rate, abs=0.1)
    mean = mean_ringing(ring, u, 0.02, time, damping)
    assert float(mean) == pytest.approx(total, abs=2e-3)


def test_waves_in_time_have_their_frequencies_and_are_half_a_period_apart():
    waves = [term for term in series_at(JOINT) if term.memory is None]
    frequencies = [term.shapes[0].value for term in waves]
    longest = float(JOINT.values["t"].max())
    assert frequencies[:2] == pytest.approx([0.5 / longest, 1.0 / longest])
    sine, cosine = waves[3].values(JOINT).unbind(-1)
    angle = 2.0 * math.pi * frequencies[3] * JOINT.values["t"]
    assert torch.allclose(sine, angle.sin()) and torch.allclose(cosine, angle.cos())


def file_with(motion, tmp_path, *symbols):
    terms = {term.memory.symbol: term for term in remembering(motion)}
    law = law_with(motion, *(terms[symbol] for symbol in symbols))
    path = tmp_path / "learned_effect.py"
    path.write_text(module_source([law], "From a test."), encoding="utf-8")
    return path


def test_a_file_with_states_is_an_effect_for_every_command(tmp_path):
    path = file_with(JOINT, tmp_path, "bend", "stretch")
    (effect,) = named_effects([f"{path}@hinge"])
    inputs = make_case("pendulum", "null", seed=5).fit.inputs(20)
    simulator = under_test.pendulum_simulator().with_effects(effect)
    c1 = torch.tensor([0.0, 0.3], dtype=torch.float64)
    still = {f"hinge.{effect.id}.c2": torch.zeros(()), f"hinge.{effect.id}.c1": c1}
    none, some = simulator.simulate(still, inputs)
    assert torch.equal(none, under_test.pendulum_simulator().simulate({}, inputs))
    unknown = simulator.simulate(still, replace(inputs, recorded_readings=None))[1]
    # Later segments begin with the bend that the motion before them left.
    differs = (some - unknown).abs().amax((1, 2)) > 0.0
    assert not differs[inputs.start == 0].any() and bool(differs.any())


def test_a_file_with_states_of_a_command_is_an_effect_for_every_command(tmp_path):
    path = file_with(COMMAND, tmp_path, "ring", "late")
    (effect,) = named_effects([f"{path}:LearnedHinge@torque"])
    inputs = make_case("pendulum", "null", seed=5).fit.inputs(20)
    simulator = under_test.pendulum_simulator().with_effects(effect)
    silent = {f"torque.{effect.id}.c{k}": torch.zeros(2) for k in (1, 2)}
    base = under_test.pendulum_simulator().simulate({}, inputs)
    assert torch.equal(simulator.simulate(silent, inputs)[0], base)
    ringing = simulator.simulate({**silent, f"torque.{effect.id}.c1": torch.ones(2)}, inputs)
    assert bool(ringing.isfinite().all()) and not torch.equal(ringing[0], base)
