"""Encoders' counts are read off the readings and take no part in the search."""

import math

import numpy as np
import pytest
from hidden_rigs import RIGS, make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.screening.encoder_resolution import count_of, counts
from npdr_ppl.discovery.screening.variants import candidates_at
from npdr_ppl.discovery.search.effect_search import Searcher
from npdr_ppl.errors import ModelError
from npdr_ppl.models.effects import Quantisation, ViscousFriction

COUNT = 2.0 * math.pi / 2048


@pytest.fixture(scope="module")
def motion():
    return np.cumsum(np.random.default_rng(0).normal(0.0, 0.01, 4000))


@pytest.mark.parametrize("precision", ["double", "single", "decimals", "offset"])
def test_a_count_is_read_off_the_readings(motion, precision):
    counted = np.round(motion / COUNT) * COUNT
    written = {
        "double": counted,
        "single": counted.astype(np.float32),
        "decimals": np.round(counted, 6),
        "offset": counted + 0.0007,
    }[precision]
    assert count_of(written) == pytest.approx(COUNT, rel=1e-6)


def test_readings_that_are_not_counted_have_no_count(motion):
    assert count_of(motion) is None
    assert count_of(np.full(10, 0.3)) is None
    # Two encoders of different counts in one channel are no encoder.
    mixed = np.concatenate([np.round(motion / c) * c for c in (COUNT, math.sqrt(2.0) * COUNT)])
    assert count_of(mixed) is None


@pytest.mark.slow
def test_counts_are_told_and_not_searched_for():
    case = make_case("pendulum", "null", (), seed=2000)
    options = npdr.DiscoveryOptions()
    fitted = Searcher(case.model, case.fit, options).fit_base()
    assert "quantisation" not in {effect.id for effect in candidates_at(fitted, options)}
    found = counts(fitted, case.fit)
    assert set(found) == {"angle"}
    (count,) = RIGS["pendulum"].measurement.counts
    assert found["angle"].size == pytest.approx(count)
    # The rounding is all the noise that this sensor has.
    assert found["angle"].share == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_who_searches_for_counts_is_told():
    case = make_case("pendulum", "null", (), seed=2000)
    options = npdr.DiscoveryOptions(effects=(ViscousFriction("hinge"), Quantisation("angle")))
    with pytest.raises(ModelError, match="read from the recording"):
        npdr.discover(case.model, case.fit, search=options)
