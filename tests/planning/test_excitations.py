"""Excitations: within the limits of the commands, band-limited, at rest at both ends."""

import math
from dataclasses import replace

import numpy as np
import pytest

from npdr_ppl.planning.excitations import Excitations
from npdr_ppl.planning.limits import ActionLimits, ChannelLimits, Limits

LIMITS = Limits(
    4.0,
    3.0,
    0.005,
    {
        "torque": ActionLimits(-1.0, 2.0, max_rate=8.0, max_acceleration=60.0, start=0.5),
        "goal": ActionLimits(0.0, 0.3),
    },
    {"angle": ChannelLimits(-1.0, 1.0, start_min=-0.2, start_max=0.4, noise=1e-3)},
)


@pytest.fixture
def excitations():
    return Excitations(LIMITS, np.random.default_rng(0))


@pytest.fixture
def candidates(excitations):
    first = excitations.random(40)
    changed = [excitations.changed(candidate, 0.5) for candidate in first]
    mixed = [excitations.mixed(a, b) for a, b in zip(first, changed, strict=True)]
    return [*first, *changed, *mixed]


def test_commands_keep_their_limits(excitations, candidates):
    for candidate in candidates:
        commands = excitations.commands(candidate)
        assert commands.shape == (800, 2)
        for column, action in zip(commands.T, LIMITS.actions.values(), strict=True):
            rate = np.diff(column) / LIMITS.time_step
            assert column.min() >= action.min - 1e-9 and column.max() <= action.max + 1e-9
            assert np.abs(rate).max() <= action.max_rate * (1.0 + 1e-9)
            assert np.abs(np.diff(rate)).max() / LIMITS.time_step <= action.max_acceleration * (
                1.0 + 1e-9
            )


@pytest.mark.parametrize("bandwidth", [3.0, 100.0])
def test_commands_are_the_series_of_their_coefficients(bandwidth):
    # 100 Hz is half the sampling rate.
    limits = replace(LIMITS, bandwidth=bandwidth, actions={"goal": ActionLimits(-1.0, 1.0)})
    made = Excitations(limits, np.random.default_rng(0))
    num, time = made.num_waves, np.arange(800) / 800
    phase = 2.0 * np.pi * np.outer(np.arange(1, num + 1), time)
    window = np.minimum(np.arange(800), 799 - np.arange(800)) * limits.time_step * 2.0 * bandwidth
    window = np.sin(0.5 * np.pi * np.minimum(window, 1.0)) ** 2
    for candidate in made.random(12):
        sines, cosines = np.split(candidate.coefficients[0], 2)
        wanted = window * (sines @ np.sin(phase) + cosines @ np.cos(phase))
        found = made.commands(candidate)[:, 0]
        assert found == pytest.approx(np.abs(found).max() * wanted / np.abs(wanted).max())


def test_the_strongest_command_reaches_a_limit():
    limits = replace(LIMITS, actions={"torque": ActionLimits(-1.0, 2.0, start=0.5)})
    made = Excitations(limits, np.random.default_rng(0))
    for candidate in made.random(20):
        torque = made.commands(replace(candidate, amplitudes=np.ones(1)))[:, 0]
        assert torque.max() == pytest.approx(2.0) or torque.min() == pytest.approx(-1.0)


@pytest.mark.parametrize("start", [0.0, 0.01, 0.3])
def test_a_command_at_rest_at_a_limit_uses_the_range(start):
    limits = replace(LIMITS, actions={"goal": ActionLimits(0.0, 0.3, start=start)})
    made = Excitations(limits, np.random.default_rng(0))
    for candidate in made.random(20):
        goal = made.commands(replace(candidate, amplitudes=np.ones(1)))[:, 0]
        assert goal.min() >= 0.0 and goal.max() <= 0.3
        assert np.ptp(goal) > 0.14
        assert goal[[0, -1]] == pytest.approx(start)


def test_commands_are_in_the_band(excitations, candidates):
    frequencies = np.fft.rfftfreq(800, LIMITS.time_step)
    for candidate in candidates:
        commands = excitations.commands(candidate)
        power = np.abs(np.fft.rfft(commands - commands.mean(0), axis=0)) ** 2
        # The window of 1/6 s at both ends widens the band a little.
        outside = power[frequencies > 2.0 * LIMITS.bandwidth].sum(0)
        assert (outside <= 0.01 * power.sum(0) + 1e-12).all()


def test_commands_begin_and_end_at_rest(excitations, candidates):
    for candidate in candidates:
        commands = excitations.commands(candidate)
        for row in (commands[0], commands[-1]):
            assert row == pytest.approx([0.5, 0.0], abs=1e-9)


def test_starts_are_in_their_range(excitations, candidates):
    starts = np.array([excitations.start(candidate) for candidate in candidates])
    assert starts.min() >= -0.2 and starts.max() <= 0.4
    assert np.ptp(starts) > 0.5


def test_the_seed_decides_everything(excitations):
    other = Excitations(LIMITS, np.random.default_rng(0))
    for one, two in zip(excitations.random(8), other.random(8), strict=True):
        assert np.array_equal(excitations.commands(one), other.commands(two))


def test_a_limit_on_acceleration_makes_commands_weaker():
    steady = replace(
        LIMITS,
        actions={"goal": ActionLimits(-1.0, 1.0, max_acceleration=1.0)},
    )
    strong = replace(LIMITS, actions={"goal": ActionLimits(-1.0, 1.0)})
    weak, usual = (Excitations(ls, np.random.default_rng(1)) for ls in (steady, strong))
    (one,), (two,) = weak.random(1), usual.random(1)
    assert np.abs(weak.commands(one)).max() < 0.2 * np.abs(usual.commands(two)).max()
    assert math.isclose(np.abs(usual.commands(two)).max(), 1.0)
