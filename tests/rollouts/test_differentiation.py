"""Smoothing derivatives against motions whose derivatives are known."""

import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.rollouts.differentiation import (
    Smoothing,
    cutoffs,
    differentiate,
    held_actions,
    thin,
)

STEP = 0.002
TIME = STEP * np.arange(4001)


def swing(time, frequency=1.5):
    return np.stack((np.sin(2 * np.pi * frequency * time), 0.3 * time**2), axis=1)


def test_derivatives_of_a_slow_motion():
    w = 2 * np.pi * 1.5
    found = differentiate(swing(TIME), STEP, 40.0)
    inside = slice(100, -100)
    np.testing.assert_allclose(
        found.velocities[inside, 0], w * np.cos(w * TIME)[inside], atol=1e-4
    )
    np.testing.assert_allclose(
        found.accelerations[inside, 0], -w * w * np.sin(w * TIME)[inside], atol=1e-3
    )
    np.testing.assert_allclose(found.accelerations[inside, 1], 0.6, atol=1e-4)


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_the_automatic_cutoff_is_where_noise_hides_the_motion(noise):
    """A motion whose accelerations are white has the spectrum h⁴/(2 sin(π f h))⁴."""
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        motion = np.cumsum(np.cumsum(rng.standard_normal(4001))) * STEP**2
        readings = motion + noise * rng.standard_normal(4001)
        position, parallel = cutoffs([readings[:, None]], STEP, Smoothing())
        assert parallel == pytest.approx(0.4 * position)
        found.append(position)
    # Motion and noise together are four times the noise where the motion is three times it.
    expected = np.arcsin(0.5 * STEP / (3 * noise**2) ** 0.25) / (np.pi * STEP)
    assert 0.6 * expected < np.median(found) < 1.2 * expected + 1.0


def test_cutoffs_can_be_chosen():
    readings = [swing(TIME)]
    assert cutoffs(readings, STEP, Smoothing(30.0, 5.0)) == (30.0, 5.0)
    assert cutoffs(readings, STEP, Smoothing(30.0)) == (30.0, pytest.approx(12.0))
    with pytest.raises(DataError, match="below half the sampling rate, 250 Hz, got 300 Hz"):
        cutoffs(readings, STEP, Smoothing(300.0))
    with pytest.raises(DataError, match="at least 64 samples, got one of 20"):
        cutoffs([swing(TIME)[:20]], STEP, Smoothing())
    with pytest.raises(DataError, match="parallel_cutoff must be a positive frequency"):
        Smoothing(parallel_cutoff=0.0)


def test_both_sides_of_an_equation_stay_equal_and_noise_goes():
    rng = np.random.default_rng(1)
    slow = np.sin(2 * np.pi * 1.0 * TIME)
    noise = rng.standard_normal(len(TIME))
    rows = thin(np.stack((slow, slow, slow + noise), axis=1), STEP, 10.0)
    assert len(rows) == pytest.approx((len(TIME) - 200) / 25, abs=1)
    np.testing.assert_array_equal(rows[:, 0], rows[:, 1])
    # The share of the sampling rate that passes is 2 · 10 Hz of 500 Hz.
    assert np.std(rows[:, 2] - rows[:, 0]) == pytest.approx(0.2, rel=0.2)


def test_held_actions_reproduce_the_held_signal_to_fourth_order():
    """A held sinusoid's own frequency is late by half a step and weaker by a sinc."""
    errors = []
    for step in (0.02, 0.01):
        time = step * np.arange(int(8 / step))
        half = 0.5 * 5.0 * step
        held = np.sin(half) / half * np.sin(5.0 * np.append(time, 8.0) - half)
        errors.append(np.abs(held_actions(np.sin(5.0 * time)[:, None])[:, 0] - held)[2:-2].max())
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.1)
    assert held_actions(np.ones((5, 2))) == pytest.approx(np.ones((6, 2)))
