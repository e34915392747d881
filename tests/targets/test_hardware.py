"""The loop for physical devices, with a device and a clock that a test controls."""

import threading

import numpy as np
import pytest

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel
from npdr_ppl.targets import HardwareTarget, TargetError, partial_rollout


class Clock:
    """Time that passes only where somebody waits or works."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def pass_by(self, seconds):
        self.now += seconds


class Cart(HardwareTarget):
    """Moves by what it is commanded; notes every call."""

    name = "cart"
    sensors = (Channel("position", "m", -1.0, 1.0),)
    actions = (Channel("velocity", "m/s", -2.0, 2.0),)
    time_step = 0.01

    def __init__(self, **options):
        self.time = Clock()
        # The watchdog lives in real time, in which a busy machine may pause.
        defaults = {"clock": self.time, "sleep": self.time.pass_by, "watchdog_timeout": 30.0}
        options = defaults | options
        super().__init__(**options)
        self.calls = []
        self.written = []
        self.position = 0.0
        self.is_stopped = threading.Event()

    def connect(self):
        self.calls.append("connect")

    def reset(self):
        self.calls.append("reset")
        self.position = 0.0

    def read(self):
        return [self.position]

    def write(self, actions):
        self.calls.append("write")
        self.written.append(actions[0])
        self.position += self.time_step * actions[0]

    def stop(self):
        self.calls.append("stop")
        self.is_stopped.set()

    def disconnect(self):
        self.calls.append("disconnect")

    def is_at_rest(self):
        return self.written[-1] == 0.0 and self.calls[-3:] == ["write", "stop", "disconnect"]


def forward(readings, time):
    return np.array([1.0])


def raising(error, after):
    def controller(readings, time):
        if round(time / Cart.time_step) == after:
            raise error
        return np.array([1.0])

    return controller


def test_an_episode_keeps_its_rate_and_ends_at_rest():
    cart = Cart()
    times = []

    def controller(readings, time):
        times.append((time, cart.time.now))
        cart.time.pass_by(0.004)
        return np.array([5.0])

    recorded = cart.run(controller, 20, seed=0)
    planned, actual = np.array(times).T
    np.testing.assert_allclose(actual, planned, atol=1e-12)
    assert recorded.lengths == (20,)
    assert np.all(recorded.actions[0] == 2.0)
    np.testing.assert_allclose(recorded.readings[0][:, 0], 0.02 * np.arange(21))
    assert cart.calls[:3] == ["connect", "reset", "write"]
    assert cart.is_at_rest()
    assert (cart.report.num_steps, cart.report.missed_deadlines) == (20, 0)


def test_leaving_the_limits_ends_the_episode():
    cart = Cart()
    recorded = cart.run(lambda readings, time: np.array([1.9]), 200, seed=0)
    assert recorded.readings[0][-1, 0] > 1.0 >= recorded.readings[0][-2, 0]
    assert recorded.lengths == (cart.report.num_steps,)
    assert "position is 1.007 m, outside -1 … 1" in cart.report.ending
    assert cart.is_at_rest()


def test_the_end_is_noted_before_the_device_is_brought_to_rest():
    class Notes:
        def __call__(self, readings, time):
            return np.array([1.0])

        def end(self, readings):
            self.ending = readings.tolist(), list(cart.calls)

    cart, notes = Cart(), Notes()
    recorded = cart.run(notes, 10, seed=0)
    readings, calls = notes.ending
    assert readings == recorded.readings[0][-1].tolist()
    assert "disconnect" not in calls


@pytest.mark.parametrize("is_event", [True, False], ids=["event", "function"])
def test_the_emergency_stop_lets_no_further_command_through(is_event):
    pressed = threading.Event()
    cart = Cart(emergency_stop=pressed if is_event else pressed.is_set)

    def controller(readings, time):
        if time > 0.045:
            pressed.set()
        return np.array([1.0])

    with pytest.raises(TargetError, match="emergency stop of cart was pressed") as caught:
        cart.run(controller, 100, seed=0)
    assert partial_rollout(caught.value).lengths == (5,)
    assert cart.written == [1.0] * 5 + [0.0]
    assert cart.is_at_rest()
    # It stays pressed until somebody releases it.
    with pytest.raises(TargetError, match="emergency stop") as caught:
        cart.run(forward, 100, seed=0)
    assert partial_rollout(caught.value) is None
    assert cart.written[-2:] == [0.0, 0.0]


@pytest.mark.parametrize("error", [ZeroDivisionError("oops"), KeyboardInterrupt()], ids=repr)
def test_exceptions_pass_through_with_the_rollout(error):
    cart = Cart()
    with pytest.raises(type(error)) as caught:
        cart.run(raising(error, after=7), 100, seed=0)
    assert caught.value is error
    assert partial_rollout(error).lengths == (7,)
    assert type(error).__name__ in cart.report.ending
    assert cart.is_at_rest()


def test_an_interrupted_wait_loses_only_the_step_without_a_reading():
    def sleep(seconds):
        if cart.time.now > 0.035:
            raise KeyboardInterrupt
        cart.time.pass_by(seconds)

    cart = Cart(sleep=sleep)
    with pytest.raises(KeyboardInterrupt) as caught:
        cart.run(forward, 100, seed=0)
    assert len(cart.written) == 6  # five commands and the one of rest
    assert partial_rollout(caught.value).lengths == (4,)


def test_a_few_late_steps_are_counted_and_not_caught_up_with():
    cart = Cart()
    starts = []

    def controller(readings, time):
        starts.append(cart.time.now)
        cart.time.pass_by(0.025 if len(starts) == 3 else 0.001)
        return np.array([0.1])

    assert cart.run(controller, 10, seed=0).lengths == (10,)
    steps = np.diff(starts)
    assert steps[2] == pytest.approx(0.025)
    np.testing.assert_allclose(np.delete(steps, 2), 0.01)
    assert cart.report.missed_deadlines == 1
    assert cart.report.largest_delay == pytest.approx(0.015)


def test_too_many_late_steps_stop_the_device():
    cart = Cart(max_missed_deadlines=3)

    def controller(readings, time):
        cart.time.pass_by(0.012)
        return np.array([0.1])

    with pytest.raises(TargetError, match="missed 4 deadlines, the worst by 2 ms") as caught:
        cart.run(controller, 100, seed=0)
    assert partial_rollout(caught.value).lengths == (3,)
    assert cart.is_at_rest()


def test_the_watchdog_stops_the_device_while_the_controller_hangs():
    cart = Cart(watchdog_timeout=0.25)
    stopped_meanwhile = []

    def controller(readings, time):
        if time > 0.025:
            stopped_meanwhile.append(cart.is_stopped.wait(30.0))
        return np.array([1.0])

    with pytest.raises(TargetError, match="silent for 0.25 s") as caught:
        cart.run(controller, 100, seed=0)
    assert stopped_meanwhile == [True]
    assert cart.written == [1.0] * 3 + [0.0]
    assert partial_rollout(caught.value).lengths == (3,)
    assert cart.is_at_rest()


def test_a_failing_connection_does_not_keep_the_device_from_being_stopped():
    class Broken(Cart):
        def write(self, actions):
            if len(self.written) == 4:
                self.calls.append("failed write")
                raise OSError("cable")
            super().write(actions)

    cart = Broken()
    with pytest.raises(OSError, match="cable") as caught:
        cart.run(forward, 100, seed=0)
    assert partial_rollout(caught.value).lengths == (4,)
    assert cart.calls[-4:] == ["failed write", "failed write", "stop", "disconnect"]


def test_a_failing_stop_after_a_whole_episode_keeps_the_rollout():
    class Broken(Cart):
        def stop(self):
            raise OSError("no answer")

    cart = Broken()
    with pytest.raises(OSError, match="no answer") as caught:
        cart.run(forward, 10, seed=0)
    assert partial_rollout(caught.value).lengths == (10,)
    assert cart.calls[-2:] == ["write", "disconnect"]


@pytest.mark.parametrize(
    ("reading", "message"),
    [([np.nan], "position of cart reported nan"), ([0.0, 0.0], "has 1 sensors, but read")],
)
def test_broken_sensors_stop_the_device_without_spoiling_the_rollout(reading, message):
    class Broken(Cart):
        def read(self):
            return reading if len(self.written) == 3 else super().read()

    cart = Broken()
    with pytest.raises(TargetError, match=message) as caught:
        cart.run(forward, 100, seed=0)
    assert partial_rollout(caught.value).lengths == (2,)
    assert cart.is_at_rest()


def test_a_start_outside_the_limits_is_refused():
    class Displaced(Cart):
        def reset(self):
            self.position = 3.0

    cart = Displaced()
    with pytest.raises(TargetError, match="starts outside its limits: position is 3 m"):
        cart.run(forward, 100, seed=0)
    assert cart.written == [0.0]


def test_wrong_declarations_show_before_the_device_is_touched():
    class Unnameable(Cart):
        sensors = (Channel("time", "s"),)

    for cart, num_steps, message in (
        (Unnameable(), 10, "reserved name"),
        (Cart(), 0, "at least one step"),
        (Cart(watchdog_timeout=0.015), 10, "two steps or more"),
    ):
        with pytest.raises((ModelError, ValueError), match=message):
            cart.run(forward, num_steps, seed=0)
        assert cart.calls == []
