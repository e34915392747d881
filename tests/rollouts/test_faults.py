"""Faults that are visible without a model cost what they touch, and nothing else."""

import numpy as np
import pytest

import npdr_ppl as npdr
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.rollouts.faults import _Faults, _spikes, without_faults

STEP = 0.01
CHANNELS = Pendulum().sensors


def recording(angle, velocity):
    readings = np.stack((angle, velocity), axis=1)
    return npdr.Rollouts.from_arrays(
        [readings],
        [np.zeros((len(readings) - 1, 1))],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=STEP,
    )


def swing(num_steps=600):
    time = STEP * np.arange(num_steps)
    noise = np.random.default_rng(0).normal(0.0, 1e-4, (2, num_steps))
    return np.sin(3.0 * time) + noise[0], 3.0 * np.cos(3.0 * time) + 3.0 * noise[1]


def test_the_step_across_lost_samples_is_not_used():
    angle, velocity = (np.delete(values, slice(200, 230)) for values in swing())
    found = without_faults(recording(angle, velocity), CHANNELS)
    assert found.spans == (((0, 199), (200, 569)),)
    (note,) = found.notes
    assert "number of gaps: 1," in note and "1.99 s" in note


def test_a_broken_last_row_costs_the_last_step():
    angle, velocity = swing()
    angle[-1], velocity[-1] = angle[-1] + 0.5, velocity[-1] - 4.0
    found = without_faults(recording(angle, velocity), CHANNELS)
    assert found.spans == (((0, 598),),)


def test_a_sample_that_was_written_twice_costs_the_step_between():
    angle, velocity = (np.insert(values, 300, values[300]) for values in swing())
    found = without_faults(recording(angle, velocity), CHANNELS)
    assert found.spans == (((0, 300), (301, 600)),)


def test_two_samples_in_the_wrong_order_are_not_used():
    angle, velocity = swing()
    for values in (angle, velocity):
        values[[300, 301]] = values[[301, 300]]
    found = without_faults(recording(angle, velocity), CHANNELS)
    assert np.argwhere(~found.samplings[0].is_read[:, 0]).ravel().tolist() == [300, 301]
    assert found.spans == (((0, 599),),) and "swapped" in found.notes[0]


def test_a_spike_costs_one_measurement_of_one_channel():
    angle, velocity = swing()
    velocity[250] += 2.0
    found = without_faults(recording(angle, velocity), CHANNELS)
    (sampling,) = found.samplings
    assert np.argwhere(~sampling.is_read).tolist() == [[250, 1]]
    assert found.spans == (((0, 599),),)
    assert found.readings[0][250, 1] == pytest.approx(swing()[1][250], abs=0.05)
    assert "one measurement of velocity" in found.notes[0] and "2.5 s" in found.notes[0]


def test_a_frozen_channel_is_not_used_while_it_is_frozen():
    angle, velocity = swing()
    angle[100:200] = angle[100]
    found = without_faults(recording(angle, velocity), CHANNELS)
    (sampling,) = found.samplings
    assert not sampling.is_read[101:200, 0].any() and sampling.is_read[:, 1].all()
    assert found.spans == (((0, 100), (200, 599)),)
    assert found.notes == ("Rollout 0: angle is frozen from 1 s to 2 s; left out.",)


def test_a_device_that_rests_most_of_the_time_has_no_fault():
    angle, velocity = swing()
    creep = 1e-9 * np.arange(1200)
    resting = recording(
        np.concatenate((angle, angle[-1] + creep)), np.concatenate((velocity, 1e2 * creep))
    )
    assert without_faults(resting, CHANNELS) is resting


def test_an_encoder_that_stands_while_the_device_rests_is_not_frozen():
    angle, velocity = swing()
    still = np.concatenate((np.round(angle / 0.01) * 0.01, np.full(900, 0.3)))
    noise = np.random.default_rng(1).normal(0.0, 1e-3, 900)
    rested = recording(still, np.concatenate((velocity, noise)))
    assert not without_faults(rested, CHANNELS).notes


def test_fast_motion_before_slow_motion_is_no_gap():
    """The swing-up before seconds of slow motion, which determine the median change."""
    time = STEP * np.arange(3000)
    angle = 0.03 * time + np.exp(-np.square(time / 0.2)) * np.sin(20.0 * time)
    velocity = np.gradient(angle, STEP) + 1e-3 * np.sin(50.0 * time)
    assert not without_faults(recording(angle, velocity), CHANNELS).notes


def test_impacts_are_neither_spikes_nor_gaps():
    height, speed, heights, speeds = 1.0, 0.0, [], []
    for _ in range(600):
        heights.append(height)
        speeds.append(speed)
        speed -= 9.81 * STEP
        height += STEP * speed
        if height < 0.0:
            height, speed = -height, -0.9 * speed
    found = without_faults(recording(np.array(heights), np.array(speeds)), CHANNELS)
    assert not found.notes


@pytest.mark.parametrize("part", np.linspace(0.0, 1.0, 11).tolist())
def test_an_impact_at_any_part_of_a_step_is_no_spike(part):
    # A ball that falls and rises at 4.9 m/s and 3.7 m/s, and hits the floor in row 300 or later.
    time = STEP * (np.arange(600) - 300 - part)
    height = np.where(time < 0.0, -4.9 * time, 3.7 * time) - 4.905 * time**2
    speed = np.where(time < 0.0, -4.9, 3.7) - 9.81 * time
    generator = np.random.default_rng(0)
    height += generator.normal(0.0, 1e-3, 600)
    near = slice(200, 400)
    found = without_faults(recording(height[near], speed[near]), CHANNELS)
    assert not any("spike" in note for note in found.notes)


def driven_pressure(seed, step=0.005, time_constant=0.03):
    """Returns a noisy first-order response [Pa] to a square wave on a slow sine, 8 s long."""
    time = step * np.arange(1600)
    between = (time > 2.0) & (time < 6.0)
    command = 0.3 * np.sin(1.5 * time) + 0.15 * between * np.sign(np.sin(6.0 * np.pi * time))
    pressure, kept = np.zeros(len(time)), np.exp(-step / time_constant)
    for k in range(len(time) - 1):
        pressure[k + 1] = kept * pressure[k] + (1.0 - kept) * 5e6 * command[k]
    return pressure + np.random.default_rng(seed).normal(0.0, 5e3, len(time))


def pressure_recording(pressure):
    return npdr.Rollouts.from_arrays(
        [pressure[:, None]],
        [np.zeros((len(pressure) - 1, 1))],
        channel_names=("pressure",),
        action_names=("valve",),
        time_step=0.005,
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_fast_response_to_steps_of_a_command_is_no_spike(seed):
    pressure = (npdr.Channel("pressure", "Pa"),)
    steps = pressure_recording(driven_pressure(seed))
    assert without_faults(steps, pressure) is steps
    # A spike between the steps is still found, and costs one measurement.
    spiked = driven_pressure(seed)
    spiked[820] += 1e6
    found = without_faults(pressure_recording(spiked), pressure)
    assert np.flatnonzero(~found.samplings[0].is_read[:, 0]).tolist() == [820]


@pytest.mark.parametrize("size", [13.0, 16.0, 19.0, 30.0])
def test_a_kink_of_any_size_is_no_spike(size):
    # The cubic through a kink's neighbours misses it by a third of the change of slope.
    kink = 3.6 * size * np.maximum(np.arange(600) - 300, 0.0)
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0.0, 1.0, 600)
        assert not len(_spikes(noise + kink))


def test_a_measurement_from_which_the_channel_decays_is_no_spike():
    # A load that jumps by 1.1 at a step of a command and then falls by 60 % per step.
    for seed in range(10):
        load = np.random.default_rng(seed).normal(0.0, 0.03, 600)
        load[300:] += 1.1 * 0.4 ** np.arange(300)
        assert not len(_spikes(load))


def test_a_position_midway_between_its_neighbours_raises_no_warning():
    # It departs from the cubic through two neighbours on each side, not from the straight line.
    _, velocity = swing()
    angle = np.linspace(0.0, 0.6, 600)
    angle[250] = 0.5 * (angle[249] + angle[251])
    found = recording(angle, velocity)
    faults = _Faults(found, 0, (0, 1), {1: 0}, {0: (0.0, 0.6), 1: (-9.0, 9.0)}, frozenset())
    assert not faults._contradict_rate(np.array([250]), 0).any()


def test_a_spike_of_a_position_is_left_out_although_its_rate_follows_in_part():
    angle, velocity = swing()
    angle[250] += 0.5
    assert "of angle" in without_faults(recording(angle, velocity), CHANNELS).notes[0]
    derived = np.gradient(angle, STEP)  # a driver that differentiates the position
    notes = without_faults(recording(angle, derived), CHANNELS).notes
    assert any("of angle left out as spikes" in note for note in notes)


def test_an_exactly_constant_speed_is_no_dead_channel():
    time = STEP * np.arange(600)
    steady = recording(2.0 * time, np.full(600, 2.0))
    assert without_faults(steady, CHANNELS) is steady


def test_a_dead_rate_is_not_used():
    angle, _ = swing()
    found = without_faults(recording(angle, np.zeros(600)), CHANNELS)
    assert found.channel_names == ("angle",)
    assert found.notes == ("velocity never changes, although angle does; it is not used.",)


@pytest.mark.parametrize("begin", [130, 150, 170, 220, 240])
def test_a_rate_is_frozen_if_its_position_bends(begin):
    angle, velocity = swing()
    velocity[begin : begin + 30] = velocity[begin]
    (note,) = without_faults(recording(angle, velocity), CHANNELS).notes
    first, last = STEP * begin, STEP * (begin + 30)
    assert note == f"Rollout 0: velocity is frozen from {first:.4g} s to {last:.4g} s; left out."


def test_what_a_frozen_rate_says_does_not_freeze_its_position():
    angle, velocity = swing()
    angle = np.round(angle / 0.02) * 0.02  # stands for twenty rows where it turns
    velocity[235:285] = velocity[235]
    (note,) = without_faults(recording(angle, velocity), CHANNELS).notes
    assert "velocity is frozen" in note


def test_a_limit_that_is_wrong_in_one_rollout_is_left_out_of_all():
    angle, velocity = swing()
    clipped = np.clip(velocity, -2.0, 2.0)
    part = slice(22, 82)  # six rows at the limit
    both = recording(angle, clipped).concatenate(recording(angle[part], clipped[part]))
    found = without_faults(both, CHANNELS)
    for sampling in found.samplings:
        assert sampling.is_read[:, 0].all()
        assert np.abs(sampling.values[sampling.is_read[:, 1], 1]).max() < 2.0


def test_a_clipped_channel_can_freeze_as_well():
    angle, velocity = swing()
    angle[100:200] = angle[100]
    clipped = np.minimum(angle, 0.7)
    found = without_faults(recording(clipped, velocity), CHANNELS)
    is_read = found.samplings[0].is_read[:, 0]
    assert not is_read[101:200].any() and not is_read[clipped == 0.7].any()
    assert [note.split(" ", 3)[3] for note in found.notes][0].startswith("looks clipped")
    assert "is frozen from" in found.notes[1]
