import numpy as np
import pytest

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel
from npdr_ppl.rollouts import Rollouts

CHANNELS = (
    Channel("angle", "rad", -4.0, 4.0),
    Channel("rate", "rad/s", -60.0, 60.0, rate_of="angle"),
)
ACTIONS = (Channel("torque", "N m", -5.0, 5.0),)


def swing(angle_factor=1.0, rate_factor=1.0, columns=("angle", "rate"), seed=0, **units):
    """A noisy swing whose columns may be in another unit than radians."""
    rng = np.random.default_rng(seed)
    time = 0.01 * np.arange(501)
    angle = np.sin(3 * time) + 0.5 * np.sin(7.3 * time)
    rate = 3 * np.cos(3 * time) + 3.65 * np.cos(7.3 * time)
    readings = {
        "angle": angle_factor * (angle + rng.normal(0, 1e-3, time.size)),
        "rate": rate_factor * (rate + rng.normal(0, 1e-1, time.size)),
    }
    return Rollouts.from_arrays(
        [np.stack([readings[name] for name in columns], axis=1)],
        [rng.uniform(-5, 5, (500, 1))],
        channel_names=columns,
        action_names=("torque",),
        time_step=0.01,
        **units,
    )


DEGREES = 180 / np.pi


def test_good_data_pass():
    swing().check(CHANNELS, ACTIONS)
    swing().check()
    swing(columns=("angle",)).check(CHANNELS, ACTIONS)  # the rate can be estimated


@pytest.mark.parametrize(
    ("rollouts", "sentence"),
    [
        (swing(columns=("rate",)), "the column angle is missing; the data have rate, torque"),
        (swing(DEGREES, DEGREES), "angle reaches .* are these degrees"),
        (swing(1.0, DEGREES), "rate reaches .* are these degrees"),
        (swing(1.0, 0.1 * DEGREES).select(["rate", "angle"]), None),
        (swing(channel_units=("deg", "rad/s")), "angle is in deg, but rad is expected"),
        (swing(1000.0), "check the unit"),
        (swing(1e-6, 1e-6), "angle never exceeds .* far below its bound .* check the unit"),
        (swing(0.0, 0.0), None),  # it never moved
        (swing(0.01, 0.01), None),
    ],
)
def test_columns_and_units(rollouts, sentence):
    if sentence is None:
        rollouts.check(CHANNELS, ACTIONS)
        return
    with pytest.raises(DataError, match=sentence):
        rollouts.check(CHANNELS, ACTIONS)


@pytest.mark.parametrize(
    ("angle_factor", "rate_factor", "sentence"),
    [
        (DEGREES, 1.0, "angle seems to be in degrees and rate in radians per second"),
        (1.0, DEGREES, "angle seems to be in radians and rate in degrees per second"),
    ],
)
def test_units_are_found_without_bounds(angle_factor, rate_factor, sentence):
    unbounded = (Channel("angle", "rad"), Channel("rate", "rad/s", rate_of="angle"))
    with pytest.raises(DataError, match=sentence):
        swing(angle_factor, rate_factor).check(unbounded, ACTIONS)
    swing(DEGREES, DEGREES).check(unbounded, ACTIONS)  # nothing contradicts itself


def test_millimetres_and_turned_signs_are_found():
    metres = (Channel("angle", "m"), Channel("rate", "m/s", rate_of="angle"))
    with pytest.raises(DataError, match="angle seems to be in millimetres and rate in metres"):
        swing(1000.0).check(metres, ACTIONS)
    with pytest.raises(DataError, match="angle falls where rate says that it rises"):
        swing(-1.0).check(metres, ACTIONS)
    with pytest.raises(DataError, match="angle reaches .* are these millimetres"):
        swing(1000.0, 1000.0).check((Channel("angle", "m", -2.0, 2.0),), ACTIONS, allow_extra=True)


def test_extra_columns():
    rollouts = swing()
    with pytest.raises(DataError, match="the column rate is not expected"):
        rollouts.check(CHANNELS[:1], ACTIONS)
    rollouts.check(CHANNELS[:1], ACTIONS, allow_extra=True)
    with pytest.raises(DataError, match="the column torque is not expected"):
        rollouts.check(CHANNELS, (), allow_extra=True)
    with pytest.raises(DataError, match="the column force is missing"):
        rollouts.check(CHANNELS, (*ACTIONS, Channel("force", "N")))


def test_an_action_that_was_read_as_a_channel():
    with pytest.raises(DataError, match=r"rate is an action, but .* actions=\['rate'\]"):
        swing().check(CHANNELS[:1], (*ACTIONS, Channel("rate", "rad/s")))


def test_duplicates():
    one, two = swing(seed=1), swing(seed=2)
    one.concatenate(two).check(CHANNELS, ACTIONS)
    with pytest.raises(DataError, match="rollouts 0 and 2 are identical"):
        one.concatenate(two, one).check(CHANNELS, ACTIONS)


def test_measured_data_pass(shared):
    channels = (
        Channel("arm_angle", "rad", -2.1, 2.1),
        Channel("pole_angle", "rad", -12.6, 12.6),
        Channel("arm_velocity", "rad/s", -63, 63, rate_of="arm_angle"),
        Channel("pole_velocity", "rad/s", -63, 63, rate_of="pole_angle"),
    )
    for name in ("swing_up_500hz_5s", "chirp_positive_250hz_10s"):
        rollouts = Rollouts.load(shared / "quanser_qube" / f"{name}.csv")
        rollouts.check(channels, (Channel("voltage", "V", -4, 4),))
        scaled = [values * np.array([DEGREES, 1, 1, 1]) for values in rollouts.readings]
        wrong = Rollouts.from_arrays(
            scaled,
            rollouts.actions,
            channel_names=rollouts.channel_names,
            action_names=rollouts.action_names,
            time_step=rollouts.time_step,
        )
        with pytest.raises(DataError, match="are these degrees"):
            wrong.check(channels, (Channel("voltage", "V"),))
        unbounded = tuple(Channel(c.name, c.unit, rate_of=c.rate_of) for c in channels)
        with pytest.raises(DataError, match="arm_angle seems to be in degrees"):
            wrong.check(unbounded, (Channel("voltage", "V"),))
