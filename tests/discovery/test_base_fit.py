"""Steps of a fit that are fine enough for its parameters."""

from clean_fits_conditions import made

import npdr_ppl as npdr
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.models.pendulum import pendulum


def test_steps_are_refined_until_parameters_do_not_compensate_for_them():
    # Midpoint steps of this recording move the length by three standard deviations.
    recording = made("pendulum", "clean", 1141).rollouts[[0, 1]]
    searcher = Searcher(pendulum, recording, npdr.DiscoveryOptions())
    found = searcher.with_finer_steps(searcher.fit_base())
    finest = pendulum
    for _ in range(2):
        finest = npdr.with_finer_steps(finest)
    best = Searcher(finest, recording, npdr.DiscoveryOptions()).fit_base()
    assert best.simulator.with_finer_steps() is None
    deviation = best.likelihood.information().inverse().diagonal().sqrt()
    assert ((found.fit.z - best.fit.z).abs() < 0.5 * deviation).all()
