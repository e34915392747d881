"""Probabilities of hypotheses."""

import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.search.evidence import weigh
from npdr_ppl.models.effects import CoulombFriction, QuadraticDrag


def test_the_true_effect_is_the_most_probable_and_probabilities_sum_to_one(dragged):
    case, hypothesis = dragged
    binding = npdr.DiscoveryOptions().binding(case.fit)
    others = [
        fit_hypothesis(case.model, case.fit, binding, effects=(effect,))
        for effect in (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    ]
    weights = weigh([hypothesis, *others], [0.0, 0.0, 0.0], seed=0)
    assert sum(weights) == pytest.approx(1.0)
    assert weights[1] > 0.99
