"""Steps of a fit that are fine enough for its parameters."""

import torch
from clean_fits_conditions import made

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_segment_model
from npdr_ppl.discovery.search import base_fit, original_model
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.errors import DataError
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.segment_model import SegmentModel
from tests.helpers.pendulum_recordings import swinging


def test_a_fit_that_cannot_begin_where_it_is_expected_is_searched_for(monkeypatch):
    near, begun = {"mass": torch.tensor(1.0)}, []

    def failing(segments, *, start, **options):
        begun.append(start)
        if start is near:
            raise DataError("It cannot be simulated.")
        return fit_segment_model(segments, start=start, **options)

    monkeypatch.setattr(base_fit, "fit_segment_model", failing)
    segments = SegmentModel(pendulum, swinging(steps=90), npdr.DataOptions(None, 30))
    found, _ = base_fit.searched_fit(segments, near=near)
    assert begun[0] is near and bool(found.fit.z.isfinite().all())


def test_steps_are_refined_until_parameters_do_not_compensate_for_them():
    # Midpoint steps of this recording move the length by three standard deviations.
    recording = made("pendulum", "clean", 1141).rollouts[[0, 1]]
    searcher = Searcher(pendulum, recording, npdr.DiscoveryOptions())
    found = searcher.with_finer_steps(searcher.fit_base())
    finest = pendulum
    for _ in range(3):
        finest = npdr.with_finer_steps(finest)
    best = Searcher(finest, recording, npdr.DiscoveryOptions()).fit_base()
    assert best.simulator.with_finer_steps() is None
    deviation = best.likelihood.information().inverse().diagonal().sqrt()
    assert ((found.fit.z - best.fit.z).abs() < 0.5 * deviation).all()


def test_a_rough_fit_is_fitted_to_convergence_once(monkeypatch):
    finished, polished = [], base_fit.polished

    def once(rough):
        assert not any(rough is found for found in finished)
        finished.append(polished(rough))
        return finished[-1]

    recording = made("pendulum", "clean", 1141).rollouts[[0, 1]]
    searcher = Searcher(pendulum, recording, npdr.DiscoveryOptions())
    given = searcher.fit_base(may_be_rough=True)
    for module in (base_fit, original_model):
        monkeypatch.setattr(module, "polished", once)
    # As where rough fits do not show which steps are likelier.
    monkeypatch.setattr(base_fit, "is_clearly_likelier", lambda one, other: False)
    settled = searcher.settled(given)
    assert len(finished) > 1 and any(settled is found for found in finished)
