"""What the fitted parameters and initial states can explain is projected out of residuals."""

from dataclasses import replace

import pytest
import torch

from npdr_ppl.discovery import hypothesis
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.projection import Projection, loss_without
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.errors import DataError
from npdr_ppl.models.effects import QuadraticDrag


def test_parameters_explain_nothing_of_a_projected_column(quiet):
    projection = Projection(quiet)
    own = quiet.linearisation.by_parameters
    scores = projection.scores(own)
    # The prior, worth one standard deviation, is all that keeps the rest from zero.
    assert scores.information.diagonal().max() < 1.0
    assert scores.absorbed.min() > 0.99


def test_the_loss_without_an_effect_equals_that_of_a_fit_without_it(dragged):
    case, without = dragged
    drag = QuadraticDrag("hinge")
    data_options = segment_options(case.fit)
    fitted = fit_hypothesis(case.model, case.fit, data_options, effects=(drag,))
    scale = fitted.fit.scale
    lost = fitted.share * float((without.losses(scale) - fitted.losses(scale)).sum())
    assert loss_without(fitted, drag) == pytest.approx(lost, rel=0.1)


def test_a_fit_beside_which_a_segment_diverges_is_refused(quiet):
    exploding = quiet.linearisation.by_starts.clone()
    exploding[0] = 1e100  # finite, and so are its squares; 1 + Gᵀ G is singular
    beside = replace(quiet)
    vars(beside)["_linearised"] = replace(quiet.linearisation, by_starts=exploding)
    with pytest.raises(DataError, match="Simulations fail right beside the model's closest fit"):
        Projection(beside)


def test_only_the_latest_large_linearisations_are_kept(quiet, monkeypatch):
    size = quiet.linearisation.num_bytes
    settings = replace(hypothesis.HYPOTHESIS, kept_bytes=int(2.5 * size))
    monkeypatch.setattr(hypothesis, "HYPOTHESIS", settings)
    monkeypatch.setattr(hypothesis, "_KEPT", hypothesis._Kept())
    fits = [replace(quiet) for _ in range(3)]
    wanted = [fit.linearisation for fit in fits]
    assert ["_linearised" in vars(fit) for fit in fits] == [False, True, True]
    again = fits[0].linearisation  # computed again, with the same result
    torch.testing.assert_close(again.by_parameters, wanted[0].by_parameters, rtol=0.0, atol=0.0)
    assert ["_linearised" in vars(fit) for fit in fits] == [True, False, True]


def test_only_the_latest_differences_are_kept(quiet, monkeypatch):
    settings = replace(hypothesis.HYPOTHESIS, kept_bytes=int(2.5 * quiet.difference.nbytes))
    monkeypatch.setattr(hypothesis, "HYPOTHESIS", settings)
    monkeypatch.setattr(hypothesis, "_KEPT", hypothesis._Kept())
    fits = [replace(quiet) for _ in range(3)]
    wanted = [fit.difference for fit in fits]
    assert ["difference" in vars(fit) for fit in fits] == [False, True, True]
    assert torch.equal(fits[0].difference, wanted[0])
    fits[1].keep_difference(wanted[1])
    assert ["difference" in vars(fit) for fit in fits] == [True, True, False]
