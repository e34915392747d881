"""Motions that repeat, and waves in step with them."""

import numpy as np
import pytest
import torch
from hidden_rigs import make_case

import npdr_ppl as npdr
from npdr_ppl.discovery.hypothesis import fit_hypothesis
from npdr_ppl.discovery.screening.repetition import keeps_in_step, period_of
from npdr_ppl.discovery.segment_options import segment_options
from npdr_ppl.models.effects import PeriodicDisturbance

TIME = 0.01 * np.arange(2000)


def test_the_period_of_a_motion_is_found_to_the_step():
    turns = 2.0 * np.pi * TIME / 3.21
    both = np.stack((np.sin(turns) + 0.5 * np.sin(2.0 * turns), np.cos(3.0 * turns)), axis=1)
    noise = np.random.default_rng(0).normal(0.0, 0.02, both.shape)
    assert period_of(both + noise) == pytest.approx(321, abs=2)


@pytest.mark.parametrize(
    "motion",
    [
        np.sin(2.0 * np.pi * 0.2 * TIME**2),  # ever faster
        np.exp(-0.3 * TIME) * np.sin(5.0 * TIME),  # fading
        np.random.default_rng(0).normal(size=len(TIME)).cumsum(),  # astray
        np.zeros(len(TIME)),
    ],
)
def test_other_motions_have_none(motion):
    assert period_of(motion[:, None]) is None


def _wave(frequency):
    """Returns a wave at the hinge, and a fitted model that has it."""
    case = make_case("pendulum", "null", (), strength=1.0, seed=2000)
    effect = PeriodicDisturbance("hinge")
    options = segment_options(case.fit)
    start = {f"{effect.name}.frequency": torch.tensor(frequency)}
    fitted = fit_hypothesis(
        case.model, case.fit, options, effects=(effect,), start=start, max_steps=1, is_rough=True
    )
    fitted.parameters[f"{effect.name}.frequency"] = torch.tensor(frequency)
    return effect, fitted


def _recording(motion, command):
    return npdr.Rollouts.from_arrays(
        [motion[:, None]],
        [command[:-1, None]],
        channel_names=("angle",),
        action_names=("torque",),
        time_step=0.01,
    )


@pytest.mark.parametrize(("frequency", "is_in_step"), [(2 / 3.2, True), (0.7, False)])
def test_a_wave_is_in_step_where_it_repeats_with_the_motion(frequency, is_in_step):
    effect, fitted = _wave(frequency)
    swings = _recording(np.sin(2.0 * np.pi * TIME / 3.2), np.zeros(len(TIME)))
    assert keeps_in_step(fitted, effect, swings) == is_in_step


@pytest.mark.parametrize(("frequency", "is_in_step"), [(2 / 3.2, True), (0.7, False)])
def test_a_wave_is_in_step_where_it_repeats_with_the_command(frequency, is_in_step):
    effect, fitted = _wave(frequency)
    fading = np.exp(-0.3 * TIME) * np.sin(5.0 * TIME)
    command = np.where(TIME > 3.0, np.sin(2.0 * np.pi * TIME / 3.2), 0.0)  # after a rest
    assert keeps_in_step(fitted, effect, _recording(fading, command)) == is_in_step


def test_a_short_command_is_no_reason_to_exclude_a_wave():
    effect, fitted = _wave(0.55)
    fading = np.exp(-0.3 * TIME) * np.sin(5.0 * TIME)
    command = np.where(TIME < 4.0, np.sin(np.pi * TIME), 0.0)  # of 0.5 Hz
    assert not keeps_in_step(fitted, effect, _recording(fading, command))


def test_without_commands_only_the_motion_counts():
    effect, fitted = _wave(0.7)
    swings = npdr.Rollouts.from_arrays(
        [np.sin(2.0 * np.pi * 0.7 * TIME)[:, None]], channel_names=("angle",), time_step=0.01
    )
    assert keeps_in_step(fitted, effect, swings)
