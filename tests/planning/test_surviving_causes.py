"""The ranges of a recording that a discovery keeps for planning."""

from dataclasses import replace

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.proof.surviving_causes import ranges


def recording(*stretches):
    """Two rollouts that begin at 0.1 and 0.2 and rise by 1 per step, with usable stretches."""
    made = npdr.Rollouts.from_arrays(
        readings=[np.arange(41.0)[:, None] + first for first in (0.1, 0.2)],
        actions=[np.arange(40.0)[:, None] for _ in range(2)],
        channel_names=("angle",),
        action_names=("torque",),
        time_step=0.1,
    )
    return replace(made, stretches=stretches)


@pytest.mark.parametrize(
    ("stretches", "starts"),
    [
        ((((0, 40),), ((0, 40),)), (0.1, 0.2)),
        # Behind a gap the robot moves already.
        ((((0, 10), (20, 40)), ((5, 40),)), (0.1, 0.1)),
        ((((3, 40),), ((5, 40),)), (3.1, 5.2)),
    ],
)
def test_a_robot_can_start_where_its_rollouts_began(stretches, starts):
    found = ranges(recording(*stretches))
    angle = found["channels"]["angle"]
    assert (angle["start_min"], angle["start_max"]) == starts
    assert angle["max"] == 40.2
    assert found["actions"]["torque"]["max_rate"] == pytest.approx(10.0)
