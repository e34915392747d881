"""What discovery says is closed is measured on the held-out recording, and on nothing else."""

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.discovery.proof.held_out_gap import Gap

DISTURBANCE = 0.5
"""Standard deviation of what is added to held-out velocities, rad/s: fifty times their noise."""


def disturbed(rollouts):
    """Returns rollouts whose velocities have white noise added."""
    rng = np.random.default_rng(0)
    readings = [
        r + DISTURBANCE * rng.standard_normal(r.shape) * [0.0, 1.0] for r in rollouts.readings
    ]
    return npdr.Rollouts.from_arrays(
        readings=readings, actions=rollouts.actions, channel_names=rollouts.channel_names,
        action_names=rollouts.action_names, time_step=rollouts.time_step,
    )  # fmt: skip


@pytest.fixture(scope="module")
def proofs(proven):
    """The same search with held-out rollouts as they were recorded, and with disturbed ones."""
    case, options, found = proven
    assert case.holdout.channel_names == ("angle", "velocity")
    holdout = disturbed(case.holdout)
    return found, npdr.discover(case.model, case.fit, holdout=holdout, search=options)


def test_the_closed_share_is_that_of_the_gap_above_the_noise_floor():
    assert Gap(3.0, 1.5, 1.0).closed == pytest.approx(0.75)
    assert Gap(3.0, 3.5, 1.0).closed == pytest.approx(-0.25)
    # Nothing is left to close, or there is no floor.
    assert Gap(1.0, 0.9, 1.0).closed is None and Gap(3.0, 1.0, None).closed is None


@pytest.mark.slow
def test_the_proof_is_of_the_held_out_rollouts(proofs):
    clean, noisy = (proof.gap for proof in proofs)
    assert clean["rmse"].closed > 0.5 and 0.8 < clean["coverage"].after <= 1.0
    for metric in ("rmse", "dtw", "crps"):
        # Noise that no model can follow is far more than the effect and the readings' own noise.
        assert noisy[metric].after > 3.0 * clean[metric].after
        assert noisy[metric].before > 3.0 * clean[metric].before
        # Without an error in the model it would be as large.
        assert noisy[metric].noise_floor > 3.0 * clean[metric].noise_floor
    # Half the readings are velocities, of which next to none is within the predicted interval.
    assert noisy["coverage"].after == pytest.approx(clean["coverage"].after / 2, abs=0.1)


@pytest.mark.slow
def test_held_out_rollouts_have_no_say_in_what_is_found(proofs):
    clean, noisy = proofs
    assert [f.to_dict() for f in clean.effects] == [f.to_dict() for f in noisy.effects]
    assert (clean.verdict, clean.reason) == (noisy.verdict, noisy.reason)
    assert clean.parameters == noisy.parameters
