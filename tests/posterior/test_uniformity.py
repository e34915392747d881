"""The simultaneous test is exact: against full enumeration, and against simulated ranks."""

from itertools import product

import numpy as np
import pytest

from npdr_ppl.errors import ShapeError
from npdr_ppl.posterior.calibration.uniformity import simultaneous_band, uniformity_p_value


@pytest.mark.parametrize(("num_ranks", "num_draws"), [(3, 3), (4, 2), (5, 3)])
def test_p_values_are_exact(num_ranks, num_draws):
    # All sets of ranks are equally probable, so a p-value v has to be seen with probability v:
    # statistics are discrete, and at every value attained the test is exact.
    every = product(range(num_draws + 1), repeat=num_ranks)
    p = np.array([uniformity_p_value(np.array(ranks), num_draws) for ranks in every])
    assert len(np.unique(p.round(9))) > 2
    for value in np.unique(p.round(9)):
        assert np.mean(p <= value + 1e-8) == pytest.approx(value, abs=1e-8)


def test_the_band_holds_uniform_ranks_as_often_as_it_says():
    num_ranks, num_draws, trials = 80, 99, 4_000
    rng = np.random.default_rng(0)
    ranks = rng.integers(0, num_draws + 1, (trials, num_ranks))
    band = simultaneous_band(num_ranks, num_draws, 0.9)
    thresholds = np.round(band.positions * (num_draws + 1))
    share = (ranks[:, :, None] < thresholds).mean(1)
    inside = np.all((share >= band.low - 1e-12) & (share <= band.high + 1e-12), axis=1)
    # Four standard errors; discreteness lets the band hold more, but little with 80 ranks.
    error = 4 * np.sqrt(0.9 * 0.1 / trials)
    assert 0.9 - error < inside.mean() < 0.93 + error


def test_ranks_leave_the_band_just_when_they_are_rejected():
    num_ranks, num_draws, level = 60, 199, 0.1
    rng = np.random.default_rng(1)
    band = simultaneous_band(num_ranks, num_draws, 1 - level)
    thresholds = np.round(band.positions * (num_draws + 1))
    p_values, inside = [], []
    for power in np.linspace(1.0, 1.6, 60):
        ranks = ((num_draws + 1) * rng.uniform(size=num_ranks) ** power).astype(np.int64)
        share = (ranks[:, None] < thresholds).mean(0)
        p_values.append(uniformity_p_value(ranks, num_draws))
        inside.append(bool(np.all((share > band.low - 1e-9) & (share < band.high + 1e-9))))
    assert {True, False} == set(inside)
    # The p-value where the discrete band lies is at most the level.
    assert max(p for p, i in zip(p_values, inside, strict=True) if not i) <= level
    assert min(p for p, i in zip(p_values, inside, strict=True) if i) > 0.9 * level


def test_extreme_ranks_give_tiny_p_values_and_malformed_ones_an_error():
    assert uniformity_p_value(np.zeros(300, dtype=np.int64), 999) < 1e-20
    for ranks in (np.zeros(0, dtype=np.int64), np.array([5]), np.array([-1]), np.ones((2, 2))):
        with pytest.raises(ShapeError, match="between 0 and 4"):
            uniformity_p_value(ranks, 4)
