"""How well a model explains a recording, before remedies are tried."""

import dataclasses

import numpy as np

from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.remedy_trials import misfits_of, relative_misfit
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.preparation.data_options import DataOptions
from tests.helpers.pendulum_recordings import swinging


def misfits(rollouts):
    options = DataOptions(None, 30)
    return misfits_of(fit_hypothesis(pendulum, rollouts, options, max_steps=6, is_rough=True))


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


def test_a_channel_that_moves_by_no_more_than_its_resolution_says_nothing():
    rollouts = swinging(steps=240)
    column = rollouts.channel_names.index("velocity")
    count = 1e-2
    idle = [values.copy() for values in rollouts.readings]
    for values in idle:
        values[:, column] = count * (np.arange(len(values)) // 40 % 2)
    assert misfits(dataclasses.replace(rollouts, readings=tuple(idle)))["velocity"] == 0.0
    # One that moves by ten times as much while the simulation does not is not explained.
    for values in idle:
        values[:, column] *= np.where(np.arange(len(values)) % 7 == 0, 10.0, 1.0)
    found = misfits(dataclasses.replace(rollouts, readings=tuple(idle)))
    assert found["velocity"] > 0.3


def test_channels_that_rest_are_not_explained_better():
    rests = {"angle": 0.0, "velocity": 2.0}
    assert relative_misfit({"angle": 0.0}, rests) == 1.0
    assert relative_misfit({"angle": 0.1}, rests) == float("inf")
    assert relative_misfit({"angle": 0.0, "velocity": 1.0}, rests) == 0.5
