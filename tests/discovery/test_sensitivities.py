"""Sensitivities of the measurements to candidate effects."""

from dataclasses import replace

import pytest
import torch
from hidden_rigs import make_case

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.screening.sensitivities import _between_unlike, sensitivities
from npdr_ppl.discovery.screening.settings import SENSITIVITY
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import (
    CoulombFriction,
    EncoderBias,
    JointElasticity,
    QuadraticDrag,
    candidate_effects,
)


def test_sensitivities_equal_finite_differences(quiet):
    (variant,) = sensitivities(quiet, (QuadraticDrag("hinge"),))
    segments, fit = quiet.segments, quiet.fit
    box = segments.black_box(fit.z[None])
    values = {k: v[None] for k, v in variant.parameters(torch.tensor([0.01]).double()).items()}
    changed = box.simulator.with_effects(variant.effect)
    moved = segments.run(changed, {**box.parameters, **values}, fit.offsets[None])[0]
    base = segments.run(box.simulator, box.parameters, fit.offsets[None])[0]
    expected = ((moved - base).double() / fit.scale).flatten(-2) / 0.01
    difference = (variant.change[..., 0] - expected).norm() / expected.norm()
    assert difference < 0.02


def test_an_effect_that_changes_nothing_but_the_last_digits_is_no_candidate():
    case = make_case("emps", "null", seed=2001)
    fitted = fit_hypothesis(case.model, case.fit, segment_options(case.fit))
    # No force of this drive depends on where it is.
    assert not list(sensitivities(fitted, (EncoderBias("position"),)))
    assert list(sensitivities(fitted, (CoulombFriction("carriage"),)))


def test_effects_simulated_in_one_batch_have_the_sensitivities_of_each_alone(quiet, monkeypatch):
    effects = candidate_effects(quiet.simulator)
    together = list(sensitivities(quiet, effects))
    one_by_one = replace(SENSITIVITY, segments_per_part=1)
    monkeypatch.setattr("npdr_ppl.discovery.screening.sensitivities.SENSITIVITY", one_by_one)
    alone = list(sensitivities(quiet, effects))
    by_name = {variant.effect.name: [] for variant in alone}
    for variant in alone:
        by_name[variant.effect.name].append(variant.change)
    assert len(together) == len(alone)
    for variant in together:
        assert torch.equal(variant.change, by_name[variant.effect.name].pop(0))


def test_sizes_of_a_resonance_that_change_the_motion_alike_are_left_out(quiet, monkeypatch):
    effects = (JointElasticity("hinge"),)
    few = list(sensitivities(quiet, effects))
    every = replace(SENSITIVITY, resonance_stride=1)
    monkeypatch.setattr("npdr_ppl.discovery.screening.sensitivities.SENSITIVITY", every)
    all_sizes = list(sensitivities(quiet, effects))
    assert len(few) < len(all_sizes) == len(SENSITIVITY.resonant_sizes)
    projection = Projection(quiet)
    (best,), (best_of_all,) = screen(projection, few), screen(projection, all_sizes)
    assert best.gain > 0.95 * best_of_all.gain
    # Each size stands for those up to the next ones that were tried, so none is excluded.
    ends = [(float(v.lower), float(v.upper)) for v in few]
    assert all(one[1] >= other[0] for one, other in zip(ends, ends[1:], strict=False))


def test_nothing_is_tried_between_sizes_of_a_resonance_that_cannot_explain_the_residuals():
    east, north = torch.eye(2, dtype=torch.float64)
    largest = 100.0
    assert _between_unlike({0: 50.0 * east, 4: 50.0 * north}, largest) == [2]
    # One of the two may explain them, and so may a size between them.
    assert _between_unlike({0: 50.0 * east, 4: 500.0 * north}, largest) == [2]
    assert _between_unlike({0: 200.0 * east, 4: 500.0 * north}, largest) == []
    # A simulation that diverges explains nothing.
    assert _between_unlike({0: 200.0 * east, 4: torch.nan * north}, largest) == []
    assert _between_unlike({0: 50.0 * east, 4: torch.nan * north}, largest) == [2]
    # No recording tells these two apart.
    assert _between_unlike({0: 0.6 * east, 4: 0.6 * north}, largest) == []
    assert _between_unlike({0: 50.0 * east, 4: 51.0 * east}, largest) == []
    assert _between_unlike({3: 50.0 * east, 4: 50.0 * north}, largest) == []


def test_a_resonance_that_explains_the_residuals_is_found_among_fewer_sizes():
    hidden = [("carriage", "joint_elasticity")]
    case = make_case("emps", "one", hidden, strength=0.3, seed=2001)
    fitted = fit_hypothesis(case.model, case.fit, segment_options(case.fit))
    projection, effects = Projection(fitted), (JointElasticity("carriage"),)
    every = list(sensitivities(fitted, effects))
    few = list(sensitivities(fitted, effects, projection=projection))
    (best,), (best_of_all,) = screen(projection, few), screen(projection, every)
    assert best.gain == pytest.approx(best_of_all.gain)
    assert len(few) < len(every)
