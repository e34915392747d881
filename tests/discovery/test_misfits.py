"""How well a model explains a recording, before remedies are tried."""

import dataclasses

import numpy as np

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.recording_repair import _misfits
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.data_options import DataOptions
from tests.helpers.pendulum_recordings import swinging


def misfits(rollouts):
    options = DataOptions(None, 30)
    return _misfits(fit_hypothesis(pendulum, rollouts, options, max_steps=6, is_rough=True))


def test_a_channel_that_never_moves_is_not_explained_by_a_simulation_that_does():
    rollouts = swinging(steps=240)
    assert max(misfits(rollouts).values()) < 0.1
    column = rollouts.channel_names.index("velocity")
    still = [values.copy() for values in rollouts.readings]
    for values in still:
        values[:, column] = 0.0
    assert misfits(dataclasses.replace(rollouts, readings=tuple(still)))["velocity"] == 10.0


def test_one_window_with_a_wrong_initial_state_does_not_count():
    rollouts = swinging(steps=240)
    torn = [values.copy() for values in rollouts.readings]
    # The window from row 30 on gets a wrong initial state; with it, 0.17 and 0.26 are left.
    torn[0][29:33] += np.array([1.0, 0.0])
    assert max(misfits(dataclasses.replace(rollouts, readings=tuple(torn))).values()) < 0.1
