"""What a discovery keeps for planning: ranges of the recording, and the causes that are left."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.proof.surviving_causes import ranges, surviving_causes
from npdr_ppl.discovery.search.alternatives import Added
from npdr_ppl.models.effects import CoulombFriction


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


def test_a_law_that_contains_the_likeliest_and_fits_hardly_better_is_no_further_cause():
    dry, drifting, drag = "hinge.coulomb_friction", "hinge.friction_drift", "hinge.quadratic_drag"
    added = Added(
        CoulombFriction("hinge"),
        dry,
        share=1.0,
        alternatives={dry: 0.6, drifting: 0.25, drag: 0.15},
        fitting=(drifting,),
        forms=(drifting,),
    )
    trials = {(dry, name): SimpleNamespace(can_be_linearised=True) for name in added.alternatives}
    search = SimpleNamespace(added=[added], trials=trials)
    found = surviving_causes(search, dry)
    assert found.hypotheses == (trials[dry, dry], trials[dry, drag])
    assert found.probabilities == pytest.approx((0.85, 0.15))
