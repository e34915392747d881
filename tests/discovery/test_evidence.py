"""Probabilities of hypotheses."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.search.evidence import closest, evidence, weigh
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import CoulombFriction, QuadraticDrag


@pytest.fixture(scope="module")
def fitted(dragged):
    """The model without an effect, with the hidden one, and with another one."""
    case, without = dragged
    data_options = segment_options(case.fit)
    return without, *(
        fit_hypothesis(case.model, case.fit, data_options, effects=(effect,))
        for effect in (QuadraticDrag("hinge"), CoulombFriction("hinge"))
    )


def test_the_true_effect_is_the_most_probable_and_probabilities_sum_to_one(fitted):
    weights = weigh(fitted, [0.0, 0.0, 0.0])
    assert sum(weights) == pytest.approx(1.0)
    assert weights[1] > 0.99


def test_hypotheses_that_fit_alike_have_their_prior_probabilities(fitted):
    _, drag, _ = fitted
    assert weigh([drag, drag], torch.tensor([0.75, 0.25]).log().tolist()) == (
        pytest.approx([0.75, 0.25])
    )


def test_the_evidence_is_the_likelihood_less_the_penalty_for_parameters(fitted):
    without, drag, _ = fitted
    assert closest(fitted) is drag
    for hypothesis in (without, drag):
        total = float(evidence([hypothesis], [0.0], drag).sum())
        loss = drag.share * float(hypothesis.losses(drag.fit.scale).sum())
        assert total == pytest.approx(-loss - hypothesis.complexity)
    assert drag.complexity > without.complexity + 1.0


def test_probabilities_do_not_depend_on_the_order_of_hypotheses(fitted):
    without, _, friction = fitted
    favouring = [0.0, -5.0]  # else friction has a probability of one either way
    one = weigh([without, friction], favouring)
    other = weigh([friction, without], favouring[::-1])
    assert other[::-1] == pytest.approx(one)


@dataclass
class Losses:
    """Stands for a fitted hypothesis whose segments have given losses.

    Attributes:
        values: Loss of each segment.
    """

    values: torch.Tensor
    complexity: float = 0.0
    share: float = 1.0

    @property
    def fit(self):
        return SimpleNamespace(scale=torch.ones(1))

    def losses(self, scale):
        return self.values


def test_correlated_measurements_count_by_their_effective_share():
    correlated = Losses(torch.full((40,), 3.0).double(), complexity=2.0, share=0.25)
    total = float(evidence([correlated], [1.0], correlated).sum())
    assert total == pytest.approx(-0.25 * 40 * 3.0 + 1.0 - 2.0)


def test_a_hypothesis_that_is_better_in_a_single_segment_is_not_certain():
    level = torch.full((40,), 1.0).double()
    everywhere, once = level.clone(), level.clone()
    everywhere -= 5.0 / 40
    once[11] -= 5.0
    # Exp(5) is 148: without resampling, both would have a probability of more than 0.99.
    assert weigh([Losses(everywhere), Losses(level)], [0.0, 0.0])[0] > 0.98
    assert 0.7 < weigh([Losses(once), Losses(level)], [0.0, 0.0])[0] < 0.9
