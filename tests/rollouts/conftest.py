from pathlib import Path

import numpy as np
import pytest

from npdr_ppl.rollouts import Rollouts

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared():
    """Folder of the measured data."""
    if not SHARED.is_dir():
        pytest.skip(f"measured data are not at {SHARED}")
    return SHARED


@pytest.fixture
def small():
    """Three rollouts of different lengths with two channels, one action and rewards."""
    rng = np.random.default_rng(0)
    lengths = (7, 4, 5)
    return Rollouts.from_arrays(
        [rng.normal(size=(n + 1, 2)) for n in lengths],
        [rng.normal(size=(n, 1)) for n in lengths],
        channel_names=("angle", "rate"),
        action_names=("torque",),
        time_step=0.02,
        rewards=[rng.normal(size=n) for n in lengths],
        channel_units=("rad", "rad/s"),
        action_units=("N m",),
    )
