"""Limits: defaults, files, and sentences about bad ones."""

import dataclasses

import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.planning.excitations import Excitations
from npdr_ppl.planning.judging import Judge, Played
from npdr_ppl.planning.limits import default_limits, read_limits

BAD = {
    "duration = ": "is not valid TOML",
    "speed = 1": "has 'speed'; known are",
    "duration = 'long'": "duration in .* is 'long', which is not a number",
    "duration = -1": r"it must be above 0",
    "duration = 0.1": "at least 50 are needed",
    "duration = inf": "more than 100000 steps",
    "time_step = 1e-6": "more than 100000 steps",
    "bandwidth = 1e3": "half the sampling rate",
    "bandwidth = 0.01": "one period of the duration",
    "actions = 1": r"write \[actions.NAME\]",
    "[actions]\ntorque = 3": "is no table of limits",
    "[actions.force]\nmax = 1": "has 'force'; known are torque",
    "[actions.torque]\nlargest = 1": "has 'largest'; known are",
    "[actions.torque]\nmin = 9": "min of torque is above its max",
    "[actions.torque]\nmin = -inf": "write min and max below",
    "[actions.torque]\nmax = true": "which is not a number",
    "[actions.torque]\nmax_rate = 0": "it must be above 0",
    "[actions.torque]\nstart = 40": "start of torque is not between",
    "[channels.angle]\nmin = 9\nmax = 1": "min of angle must be below max",
    "[channels.angle]\nstart_min = 0.5": "start_min of angle is above its start_max",
    "[channels.angle]\nstart_min = -20": "angle may start outside its min and max",
    "[channels.angle]\nnoise = nan": "which is not a number",
    "[channels.angle]\nnoise = inf": "noise of angle must be finite",
    "[channels.angle]\nmin = -inf\nstart_min = -inf": "start_min of angle must be finite",
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_file_gets_one_sentence(text, unrecorded, tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text(text)
    with pytest.raises(DataError, match=BAD[text]) as raised:
        read_limits(file, unrecorded[1])
    assert "\n" not in str(raised.value)


def test_a_file_that_is_not_there_is_named(unrecorded, tmp_path):
    with pytest.raises(DataError, match="limits.toml cannot be read"):
        read_limits(tmp_path / "limits.toml", unrecorded[1])


@pytest.mark.slow
def test_printed_limits_are_read_back(surviving, tmp_path):
    limits = surviving[1]
    file = tmp_path / "limits.toml"
    file.write_text(limits.toml({"angle": "rad"}))
    read = read_limits(file, limits)
    for name, channel in limits.channels.items():
        given, found = dataclasses.astuple(channel), dataclasses.astuple(read.channels[name])
        assert found == pytest.approx(given, rel=1e-5)
    assert read.num_steps == limits.num_steps


def recorded(**changes):
    """Ranges of a pendulum's recording."""
    still = {"min": 0.0, "max": 0.0, "start_min": 0.0, "start_max": 0.0}
    torque = still | {"min": -1.0, "max": 1.0, "max_rate": 20.0, "bandwidth": 1.0}
    angle = still | {"min": -0.9, "max": 1.0, "start_min": 1.0, "start_max": 1.0}
    ranges = {
        "actions": {"torque": torque | changes.pop("torque", {})},
        "channels": {"angle": angle, "velocity": still | {"min": -6.0, "max": 6.0}},
        "noise": {"angle": 0.002, "velocity": 0.01},
        "time_step": 0.02,
        "seconds": 5.0,
    }
    return ranges | changes


def test_the_slowest_band_is_read_back_as_printed(unrecorded, tmp_path):
    # One period in 7 s is 0.142857142… Hz, more than its first six digits.
    simulator = unrecorded[0].causes[0].simulator
    slow = default_limits(simulator, recorded(seconds=7.0, torque={"bandwidth": 0.0}))
    file = tmp_path / "limits.toml"
    file.write_text(slow.toml({}))
    assert read_limits(file, unrecorded[1]) == slow


def test_a_command_that_was_constant_stays_constant(unrecorded, tmp_path):
    simulator = unrecorded[0].causes[0].simulator
    constant = {"min": 0.5, "max": 0.5, "start_min": 0.5, "max_rate": 0.0, "bandwidth": 0.0}
    held = default_limits(simulator, recorded(torque=constant))
    file = tmp_path / "limits.toml"
    file.write_text(held.toml({}))
    assert read_limits(file, held) == held
    made = Excitations(held, np.random.default_rng(0))
    for candidate in made.random(5):
        assert (made.commands(candidate) == 0.5).all()


def test_a_robot_may_start_at_the_end_of_its_range(unrecorded):
    known, _ = unrecorded
    limits = read_limits(None, default_limits(known.causes[0].simulator, recorded()))
    judge = Judge(known, limits, seed=0)
    shape = len(known.causes), 1, limits.num_steps, 2
    for side, is_kept in ((0.0, True), (-0.84, True), (-0.88, False), (-1.0, False)):
        # From the greatest angle that was recorded to the other side, slowly.
        readings = np.zeros(shape)
        readings[..., 0] = np.linspace(1.0, side, limits.num_steps)
        played = Played(np.zeros((1, limits.num_steps, 1)), np.array([[1.0, 0.0]]), readings)
        # A margin of 5 % of half the range of 1.9 rad is kept where it does not start.
        assert (judge.violation(played)[0] <= 0.0) == is_kept


@pytest.mark.slow
def test_what_a_file_does_not_name_keeps_its_default(surviving, tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text("[channels.velocity]\nmax_rate = 3.0\n")
    read, limits = read_limits(file, surviving[1]), surviving[1]
    assert read.channels["velocity"].max_rate == 3.0
    assert read.channels["velocity"].max == limits.channels["velocity"].max
    assert read.actions == limits.actions


@pytest.mark.slow
def test_a_narrower_command_moves_the_command_at_rest_inside(surviving, tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text("[actions.torque]\nmin = 1.0\nmax = 2.0\n")
    assert read_limits(file, surviving[1]).actions["torque"].start == 1.0


@pytest.mark.slow
def test_the_limits_of_a_recording_are_its_ranges(ambiguous, surviving):
    case, _ = ambiguous
    limits, recorded = surviving[1], case.fit[[0]]
    assert limits.actions["torque"].max == recorded.actions[0].max()
    assert limits.channels["angle"].min == recorded.readings[0][:, 0].min()
    assert limits.duration == pytest.approx(5.0)
    # Its multisine has frequencies up to 2 Hz.
    assert 0.3 < limits.bandwidth < 2.2


@pytest.mark.slow
def test_columns_that_the_model_lacks_have_no_limits(surviving):
    known, limits = surviving
    recorded = dict(known.recorded)
    recorded["channels"] = recorded["channels"] | {"temperature": recorded["channels"]["angle"]}
    recorded["actions"] = recorded["actions"] | {"fan": recorded["actions"]["torque"]}
    assert default_limits(known.causes[0].simulator, recorded) == limits


def test_a_command_that_cannot_be_zero_begins_at_its_end(unrecorded, monkeypatch):
    simulator = unrecorded[0].causes[0].simulator
    throttle = dataclasses.replace(simulator.actions[0], lower=0.2, upper=0.9)
    monkeypatch.setattr(type(simulator), "actions", (throttle,))
    limits = read_limits(None, default_limits(simulator, None))
    assert limits.actions["torque"].start == 0.2


def test_without_a_recording_the_model_declares_them(unrecorded):
    known, limits = unrecorded
    torque = known.causes[0].simulator.actions[0]
    assert (limits.actions["torque"].min, limits.actions["torque"].max) == (
        torque.lower,
        torque.upper,
    )
    assert default_limits(known.causes[0].simulator, None) == limits
