"""Sensitivities of the measurements to candidate effects."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hidden_rigs import make_case

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.resonance_sizes import _between_unlike
from npdr_ppl.discovery.screening.screening import screen
from npdr_ppl.discovery.screening.sensitivities import sensitivities
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
    monkeypatch.setattr("npdr_ppl.discovery.screening.resonance_sizes.SENSITIVITY", every)
    all_sizes = list(sensitivities(quiet, effects))
    assert len(few) < len(all_sizes) == len(SENSITIVITY.resonant_sizes)
    projection = Projection(quiet)
    (best,), (best_of_all,) = screen(projection, few), screen(projection, all_sizes)
    assert best.gain > 0.95 * best_of_all.gain
    # Each size stands for those up to the next ones that were tried, so none is excluded.
    ends = [(float(v.lower), float(v.upper)) for v in few]
    assert all(one[1] >= other[0] for one, other in zip(ends, ends[1:], strict=False))


def residuals(*values):
    """A projection of residuals from which nothing is left out."""
    residual = torch.tensor(values, dtype=torch.float64)

    def scores(columns):
        flat = columns.flatten(0, 1)
        return SimpleNamespace(information=flat.mT @ flat, score=flat.mT @ residual)

    return SimpleNamespace(misfit=float(residual @ residual), scores=scores)


@pytest.mark.parametrize(
    ("one", "other", "is_middle_tried"),
    [
        ((40.0, 0.0), (0.0, 40.0), True),
        # One of the two may explain the residuals, and so may a size between them.
        ((40.0, 0.0), (0.0, 500.0), True),
        ((200.0, 0.0), (0.0, 500.0), False),
        # The larger one stands for smaller sizes, too, whose change is two thirds of its own.
        ((120.0, 0.0), (0.0, 140.0), True),
        ((120.0, 0.0), (0.0, 150.0), False),
        # A simulation that diverges explains nothing.
        ((200.0, 0.0), (math.nan, 0.0), False),
        ((40.0, 0.0), (math.nan, 0.0), True),
        # Noise does not tell these two apart, and the residuals do only if they point there.
        ((0.0, 0.6), (0.0, -0.3), False),
        ((0.6, 0.0), (-0.3, 0.0), True),
        ((40.0, 0.0), (41.0, 1.0), False),
    ],
)
def test_sizes_of_a_resonance_that_cannot_tell_more_are_not_tried(one, other, is_middle_tried):
    known = {k: torch.tensor([[c]], dtype=torch.float64) for k, c in ((0, one), (4, other))}
    wanted = [2] if is_middle_tried else []
    assert _between_unlike(known, residuals(50.0, 0.0)) == wanted
    beside = {3: known[0], 4: known[4]}
    assert _between_unlike(beside, residuals(50.0, 0.0)) == []


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


def test_a_size_that_diverges_leaves_the_products_of_the_others(quiet):
    projection = Projection(quiet)
    (variant,) = sensitivities(quiet, (QuadraticDrag("hinge"),))
    lost = torch.full_like(variant.change, math.nan)
    alone, both = (
        projection.scores(torch.cat(c, -1)) for c in ((variant.change,), (variant.change, lost))
    )
    assert both.information[0, 0] == pytest.approx(float(alone.information[0, 0]))
    assert both.score[0] == pytest.approx(float(alone.score[0]))
