"""How quickly a recording moves, and the segments that follow from it."""

import numpy as np
import pytest

from npdr_ppl.preparation.data_options import default_segment_length
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.motion_time import motion_time


def waves(*frequencies, time_step=0.02, seconds=60.0, noise=0.0):
    time = np.arange(0.0, seconds, time_step)
    values = np.stack([np.sin(2.0 * np.pi * f * time + f) for f in frequencies], axis=1)
    return values + noise * np.random.default_rng(0).standard_normal(values.shape)


@pytest.mark.parametrize("frequency", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("noise", [0.0, 0.03, 0.1])
def test_a_sine_takes_a_radian(frequency, noise):
    found = motion_time([waves(frequency, noise=noise)], 0.02)
    # Noise makes it a little less.
    assert found == pytest.approx(1.0 / (2.0 * np.pi * frequency), abs=0.04, rel=2.0 * noise)


def test_channels_that_stand_still_or_are_noise_do_not_count():
    values = np.concatenate([waves(0.1), waves(0.1, noise=30.0), np.ones((3000, 2))], axis=1)
    assert motion_time([values], 0.02) == motion_time([waves(0.1)], 0.02)
    assert motion_time([np.ones((100, 2))], 0.02) == 0.0


def test_a_drift_is_a_straight_line():
    drift = 600.0 * np.linspace(0.0, 1.0, 3000)[:, None]
    assert motion_time([waves(1.0) + drift], 0.02) > motion_time([waves(1.0)], 0.02)
    assert motion_time([drift + 1e-6 * waves(20.0)], 0.02) == pytest.approx(200 * 0.02)


def test_what_moves_most_counts():
    slow, fast, still = waves(0.1), waves(2.5), np.zeros((3000, 1))
    assert motion_time([slow, fast], 0.02) == motion_time([fast, still], 0.02) == 0.08
    assert motion_time([slow, 0.01 * fast[:50]], 0.02) > 1.0
    assert motion_time([slow[:3], slow[:1]], 0.02) <= 0.04
    assert motion_time([slow[:2]], 0.02) == 0.0


@pytest.mark.parametrize(
    ("frequency", "time_step", "seconds", "steps"),
    [
        (5.0, 0.002, 20.0, 100),  # fast: 0.2 s
        (0.1, 0.02, 60.0, 78),  # slow: 1.6 s
        (0.1, 0.02, 30.0, 46),  # slow and short: at least 32 segments
        (0.1, 0.001, 60.0, 200),  # no more steps, for the sake of memory
    ],
)
def test_segments_of_slow_motion_are_longer(frequency, time_step, seconds, steps):
    values = waves(frequency, time_step=time_step, seconds=seconds)
    rollouts = Rollouts.from_arrays(values[None], channel_names=("angle",), time_step=time_step)
    assert default_segment_length(rollouts) == steps
