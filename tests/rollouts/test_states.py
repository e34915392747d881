import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.states import estimate_states

COUNT = 2 * np.pi / 2048


@pytest.fixture(scope="module")
def swing():
    """A driven pendulum with velocities to 20 rad/s: time to (angle, rate), exact."""
    solution = solve_ivp(
        lambda t, s: (s[1], -100 * np.sin(s[0]) - 0.5 * s[1] + 60 * np.sin(8.2 * t)),
        (0, 5),
        (0.1, 0.0),
        dense_output=True,
        rtol=1e-9,
        atol=1e-9,
    )
    return solution.sol


@pytest.mark.parametrize(
    ("rate", "noise", "fraction"),
    # Fractions of the error of naive differences; measured 0.16, 0.07, 0.035 without further
    # noise and 0.11, 0.10, 0.05 with it.
    [(250, 0, 0.25), (500, 0, 0.12), (1000, 0, 0.06), (250, 2e-3, 0.3), (500, 2e-3, 0.3)],
)
def test_velocity_from_a_quantised_encoder(swing, rate, noise, fraction):
    rng = np.random.default_rng(0)
    time = np.arange(5 * rate + 1) / rate
    angle, velocity = swing(time)
    readings = COUNT * np.round((angle + noise * rng.normal(size=time.size)) / COUNT)
    steps = np.arange(10, time.size - 10, 7)
    estimate = estimate_states(readings[:, None], steps, 1 / rate)
    value, slope = estimate.values, estimate.rates
    naive = np.gradient(readings, 1 / rate)[steps]
    error = np.sqrt(np.mean((slope[:, 0] - velocity[steps]) ** 2))
    assert error < fraction * np.sqrt(np.mean((naive - velocity[steps]) ** 2))
    # Rounding alone has an error of COUNT / √12.
    value_error = np.sqrt(np.mean((value[:, 0] - angle[steps]) ** 2))
    assert value_error < np.hypot(COUNT / np.sqrt(12), noise)


@pytest.mark.parametrize("noise", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("rate", [250, 500, 1000])
def test_errors_are_as_large_as_they_say(swing, rate, noise):
    """Within a factor of two, for values and rates, whatever the sampling and the noise."""
    rng = np.random.default_rng(0)
    time = np.arange(5 * rate + 1) / rate
    angle, velocity = swing(time)
    readings = COUNT * np.round(angle / COUNT + noise * rng.normal(size=time.size))
    steps = np.arange(10, time.size - 10, 7)
    estimate = estimate_states(readings[:, None], steps, 1 / rate)
    value = (estimate.values[:, 0] - angle[steps]) / estimate.value_errors[:, 0]
    slope = (estimate.rates[:, 0] - velocity[steps]) / estimate.rate_errors[:, 0]
    for score in (value, slope):
        assert 0.5 < np.sqrt(np.mean(score**2)) < 2.0
        assert np.quantile(np.abs(score), 0.95) < 3.0


def test_the_ends_of_a_rollout(swing):
    """One-sided windows: worse than inside, yet far better than a difference of two readings."""
    time = np.arange(301) / 500
    errors, naive = [], []
    for begin in np.arange(0, 4, 0.1):
        angle, velocity = swing(begin + time)
        readings = COUNT * np.round(angle / COUNT)
        slope = estimate_states(readings[:, None], np.array([0, 300]), 1 / 500).rates
        errors += list(slope[:, 0] - velocity[[0, -1]])
        naive += list(np.diff(readings)[[0, -1]] * 500 - velocity[[0, -1]])
    assert np.sqrt(np.mean(np.square(errors))) < 0.5 * np.sqrt(np.mean(np.square(naive)))


def test_a_slow_motion_below_one_count_per_window():
    """Readings that stay on a count for many samples repeat one error; it is not averaged."""
    time = np.arange(2001) / 1000
    readings = COUNT * np.round(0.05 * time / COUNT)
    slope = estimate_states(readings[:, None], np.arange(200, 1800, 20), 1e-3).rates
    assert np.abs(slope - 0.05).max() < 0.05


def test_smooth_data_are_differentiated_exactly():
    time = np.linspace(0, 1, 101)
    cubic = 1 + 2 * time - 3 * time**2 + 0.5 * time**3
    channels = np.stack([cubic, np.zeros_like(time), 7 * np.ones_like(time)], axis=1)
    steps = np.array([0, 1, 50, 100])
    estimate = estimate_states(channels, steps, 0.01)
    slope = estimate.rates
    np.testing.assert_allclose(estimate.values, channels[steps], atol=1e-12)
    np.testing.assert_allclose(slope[:, 0], (2 - 6 * time + 1.5 * time**2)[steps], atol=1e-9)
    np.testing.assert_allclose(slope[:, 1:], 0, atol=1e-10)


def test_a_reading_that_fades_away():
    """A low-pass that comes to rest ends in differences too small to divide by."""
    readings = np.exp(-np.arange(2_000.0))[:, None]
    estimate = estimate_states(readings, np.array([0, 1_000]), 0.01)
    assert np.isfinite(estimate.values).all() and np.isfinite(estimate.value_errors).all()


def test_the_first_value_of_rollouts_that_begin_alike_has_no_common_error():
    """Released at rest, a pendulum's speed has a bend that a one-sided window smooths away."""
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(200)
    speed = -4.0 * np.sin(4.0 * time) + 0.3 * np.sin(60.0 * time)
    errors = np.array(
        [
            estimate_states(
                (speed + 0.02 * rng.normal(size=200))[:, None], np.array([0]), 0.01
            ).values[0, 0]
            for _ in range(60)
        ]
    )
    assert abs(errors.mean()) < 3.0 * 0.02 / 60**0.5


@pytest.mark.parametrize("num_rows", [2, 3, 4, 5])
def test_very_short_rollouts(num_rows):
    readings = (3.0 + 2.0 * np.arange(num_rows))[:, None]
    estimate = estimate_states(readings, np.arange(num_rows), 0.5)
    np.testing.assert_allclose(estimate.values, readings, atol=1e-12)
    np.testing.assert_allclose(estimate.rates, 4.0, atol=1e-10)


def test_channels_and_steps_do_not_influence_each_other(swing):
    rng = np.random.default_rng(1)
    angle, rate = swing(np.arange(1001) / 250 * 0.9)
    readings = np.stack([angle, rate], axis=1) + 1e-3 * rng.normal(size=(1001, 2))
    steps = np.arange(0, 1000, 50)
    together = estimate_states(readings, steps, 0.004)
    alone = estimate_states(readings[:, 1:], steps[3:4], 0.004)
    for name in ("values", "rates", "value_errors", "rate_errors"):
        ours, own = getattr(together, name), getattr(alone, name)
        np.testing.assert_allclose(ours[3, 1:], own[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "error"), [("swing_up_500hz_5s", 0.006), ("chirp_positive_250hz_10s", 0.016)]
)
def test_recorded_velocities_are_the_estimates_low_passed(shared, name, error):
    """The rig's driver reports the encoders' differences behind a low-pass of 52.5 rad/s.

    Estimates put through the same filter reproduce the recorded velocities to a few per cent of
    what separates them without it, for the arm and the pole; what is left are encoder counts.
    """
    rollouts = Rollouts.load(shared / "quanser_qube" / f"{name}.csv")
    lag = 52.5 * rollouts.time_step
    decay = np.exp(-lag)
    trailing = (1 - decay) / lag  # of values that change along a line between samples
    for readings in rollouts.readings[:2]:
        steps = np.arange(len(readings))
        rates = estimate_states(readings[:, :2], steps, rollouts.time_step).rates
        lagged = lfilter([1 - trailing, trailing - decay], [1, -decay], rates, axis=0)
        lag_error = np.sqrt(np.mean((rates - readings[:, 2:]) ** 2, axis=0))
        rest = np.sqrt(np.mean((lagged - readings[:, 2:]) ** 2, axis=0))
        assert (rest < 0.09).all() and (lag_error > 0.7).all()
        differences = (
            np.diff(readings[:, :2], axis=0, prepend=readings[:1, :2]) / rollouts.time_step
        )
        driver = lfilter([1 - decay], [1, -decay], differences, axis=0)
        # After ten time constants, when it does not matter any more where the filter started, and
        # without the last reading, which is off by itself (1.6 rad/s in the chirps).
        begun = round(10 / lag)
        assert np.sqrt(np.mean((driver - readings[:, 2:])[begun:-1] ** 2)) < error
