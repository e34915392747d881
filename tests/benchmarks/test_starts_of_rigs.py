"""Errors of estimated states on recordings whose true states are known."""

import numpy as np
import pytest
from hidden_rigs import RIGS

from npdr_ppl.rollouts.states import estimate_states
from tests.helpers.rig_recordings import recording_of


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "emps", "cart_pole", "furuta"])
def test_estimated_states_are_as_far_off_as_they_say(name):
    rig = RIGS[name]
    recording = recording_of(name)
    number = len(rig.layout.joints)
    off = []
    for readings, true in zip(recording.rollouts.readings, recording.true_states, strict=True):
        steps = np.arange(0, len(readings) - 1, 10)
        found = estimate_states(readings, steps, rig.time_step)
        values = (found.values[:, :number] - true[steps, :number]) / found.value_errors[:, :number]
        rates = (found.rates[:, :number] - true[steps, number:]) / found.rate_errors[:, :number]
        off.append(np.stack((values, rates)))
    # A quarter is what rigs differ by; with three standard errors rates were off by up to 1.6.
    spread = np.sqrt(np.square(np.concatenate(off, axis=1)).mean(axis=1))
    assert ((spread > 0.8) & (spread < 1.25)).all(), spread
