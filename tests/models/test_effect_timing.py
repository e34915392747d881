"""Late sensors and skewed clocks against motions whose readings have closed forms."""

import math

import pytest
import torch

from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    ActuatorLag,
    ClockSkew,
    EncoderScale,
    InputDelay,
    PeriodicDisturbance,
    SensorDelay,
)
from npdr_ppl.models.emps import Emps
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear
from tests.helpers.effect_replay import FREE, replay


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.0107])
def test_a_delayed_ramp_is_the_ramp_from_what_was_read(delay):
    """At constant speed a late reading is a shifted one, and the segment starts from it."""
    simulator = Emps().with_effects(SensorDelay("position"))
    out = replay(
        simulator, FREE | {"position.sensor_delay.delay": delay}, [0.0] * 40, start=[0.1, 0.5]
    )
    ramp = 0.1 + 0.5 * Emps.time_step * torch.arange(1, 41, dtype=torch.float64)
    torch.testing.assert_close(out[:, 0], ramp, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("integrator", "share"), [("constant-acceleration", 3e-3), ("rk4", 2e-4)])
def test_delays_of_all_sensors_and_of_the_input_are_one_class(integrator, share):
    """From one reading, late commands and late readings give one trajectory.

    What is left is the interpolation between readings.
    """
    volts = 3.0 * torch.sin(9.0 * 0.002 * torch.arange(-20, 300, dtype=torch.float64))
    everything = ",".join(sensor.name for sensor in Furuta.sensors)
    sensors, voltage = SensorDelay(everything), InputDelay("voltage")

    def run(*effects):
        return replay(
            Furuta(integrator=integrator).with_effects(*effects),
            {f"{effect.name}.delay": 0.0113 for effect in effects},
            volts[20:],
            start=[0.1, 0.4, 0.0, 0.5],
            past_actions=volts[None, :20, None],
        )

    effect = (run() - run(voltage)).abs().amax(0)
    difference = (run(sensors) - run(voltage)).abs().amax(0)
    assert (difference < share * effect).all()


def reached(effect_id, value, commands, parts):
    """The commands that reach the dynamics in each of many parts of a step of 20 ms."""
    part = 0.02 / parts
    middle = part * (torch.arange(len(commands) * parts) + 0.5)
    if effect_id == "input_delay":
        return commands[((middle - value) / 0.02).floor().long().clamp_min(0)]
    output, result = commands[0], []
    for command in commands.repeat_interleave(parts):
        before, output = output, command + (output - command) * math.exp(-part / value)
        result.append(command + (before - output) * value / part)
    return torch.stack(result)


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize(
    ("effect", "value"),
    [
        (InputDelay("torque"), 0.007),
        (InputDelay("torque"), 0.031),
        (ActuatorLag("torque"), 0.002),
        (ActuatorLag("torque"), 0.02),
    ],
    ids=lambda value: getattr(value, "id", value),
)
def test_commands_that_change_within_a_step_move_positions_when_they_do(effect, value, substeps):
    """A step's mean command moves velocities as far, but positions by half a step too early."""
    time = 0.02 * torch.arange(40, dtype=torch.float64)
    commands = 2.0 * torch.sin(8.0 * time) + torch.sign(torch.sin(13.0 * time))

    def swing(simulator, commands, parameters, time_step):
        return replay(simulator, parameters, commands, start=[0.3, 0.0], time_step=time_step)

    name = f"{effect.name}.{effect.parameters[0].name}"
    simulator = Pendulum(integrator="rk4", substeps=substeps)
    found = swing(simulator.with_effects(effect), commands, {name: value}, 0.02)
    fine = reached(effect.id, value, commands, 100)
    expected = swing(Pendulum(integrator="rk4"), fine, {}, 0.02 / 100)[99::100]
    assert (found - expected)[:, 0].abs().max() < 4e-5  # 7e-4 with the means alone


@pytest.mark.parametrize("delay", [0.007, 0.047])
def test_segments_of_late_sensors_start_from_where_the_commands_since_have_led(delay):
    """A pendulum under commands that change with every step, read in the middle of its swing."""
    step, parts, begin, num = 0.02, 200, 15, 25
    time = step * torch.arange(begin + num, dtype=torch.float64)
    commands = 2.0 * torch.sin(8.0 * time) + 1.5 * torch.sign(torch.sin(23.0 * time))
    fine = commands.repeat_interleave(parts)
    truth = replay(Pendulum(integrator="rk4"), {}, fine, start=[0.3, 0.0], time_step=step / parts)
    # What is read at each step's start: the state of `delay` before.
    late = truth[parts * torch.arange(begin, begin + num + 1) - round(delay / step * parts) - 1]
    out = replay(
        Pendulum(integrator="rk4").with_effects(SensorDelay("angle,velocity")),
        {"angle,velocity.sensor_delay.delay": delay},
        commands[begin:],
        late[0].tolist(),
        begin,
        past_actions=commands[None, :begin, None],
        time_step=step,
    )
    # Where it is kinked a parabola misses the motion by as much.
    assert (out - late[1:])[:, 0].abs().max() < 3e-4


def test_late_positions_are_read_along_a_parabola_and_velocities_along_a_line():
    """Of a constant acceleration; before the delay has passed they are continued backwards."""
    simulator = Emps(integrator="rk4").with_effects(SensorDelay("position,velocity"))
    free = FREE | {"position,velocity.sensor_delay.delay": 0.0027}
    push = replay(Emps(integrator="rk4"), FREE, [1.0] * 30)
    acceleration = push[-1, 1] / (30 * Emps.time_step)
    before = torch.ones(1, 8, 1).double()
    out = replay(simulator, free, [1.0] * 30, step=8, past_actions=before)
    late = Emps.time_step * torch.arange(1, 31, dtype=torch.float64)
    # What was read at the start is the state of then; the motion began by the delay earlier.
    expected = torch.stack((0.5 * acceleration * late**2, acceleration * late), dim=-1)
    torch.testing.assert_close(out, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0027, 0.01])
def test_late_sensors_show_a_robot_that_is_released_from_rest_where_it_was_held(delay):
    """Its fall begins with the rollout, not earlier, and is read late."""
    simulator = Pendulum(integrator="rk4").with_effects(SensorDelay("angle,velocity"))
    given = {"angle,velocity.sensor_delay.delay": delay}
    num, step = 30, Pendulum.time_step
    out = replay(simulator, given, [0.0] * num, start=[1.0, 0.0])
    acceleration = replay(Pendulum(integrator="rk4"), {}, [0.0], start=[1.0, 0.0], time_step=1e-4)
    acceleration = acceleration[0, 1] / 1e-4
    late = (step * torch.arange(1, 4, dtype=torch.float64) - delay).clamp_min(0.0)
    torch.testing.assert_close(out[:3, 1], acceleration * late, rtol=0.01, atol=1e-9)
    # A parabola through two equal values and the first that moves is off by a h²/8 at most.
    most = float(acceleration.abs()) * step**2 / 8.0
    torch.testing.assert_close(
        out[:3, 0], 1.0 + 0.5 * acceleration * late**2, rtol=0.0, atol=1.1 * most
    )


def test_late_sensors_show_an_episodes_first_pose_until_their_delay_has_passed():
    simulator = Pendulum().with_effects(SensorDelay("angle,velocity"))
    given = {"angle,velocity.sensor_delay.delay": torch.tensor(0.0207, dtype=torch.float64)}
    policy = Linear(("angle", "velocity"), ("torque",))
    policy.parameters = torch.zeros_like(policy.parameters).double()
    start = torch.tensor([[1.0, 0.0], [1.0, 0.5]], dtype=torch.float64)
    episodes = simulator.roll_out(given, policy, start, 10, record=True)
    held, moving = episodes.readings[:, 1, 1].tolist()
    assert held == 0.0 and abs(moving - 0.5) > 0.005


def test_a_robot_that_begins_in_motion_moved_before():
    simulator = Pendulum(integrator="rk4").with_effects(SensorDelay("angle,velocity"))
    given = {"angle,velocity.sensor_delay.delay": 0.01}
    out = replay(simulator, given, [0.0] * 30, start=[1.0, 0.5])
    on_time = replay(Pendulum(integrator="rk4"), {}, [0.0] * 30, start=[1.0, 0.5])
    torch.testing.assert_close(out, on_time, rtol=1e-3, atol=5e-4)


@pytest.mark.parametrize(
    ("effect", "value"),
    [
        (SensorDelay("position"), 0.0107),
        (EncoderScale("position"), 0.02),
        (ClockSkew("clock"), 2e-3),
    ],
    ids=lambda x: getattr(x, "id", ""),
)
def test_velocities_derived_from_readings_have_their_errors(effect, value):
    """A falling body whose state is estimated from readings at a segment's start."""
    fall, begin = 3.0, 400
    time = Emps.time_step * torch.arange(begin, begin + 41, dtype=torch.float64)
    scale, rate, late = {
        "sensor_delay": (1.0, 1.0, value),
        "encoder_scale": (1.0 + value, 1.0, 0.0),
        "clock_skew": (1.0, 1.0 + value, 0.0),
    }[effect.id]
    position = scale * 0.5 * fall * (rate * time - late) ** 2
    read_rate = scale * fall * (rate * time[0] - late) * rate
    inputs = Inputs(
        actions=torch.full((1, 40, 1), fall, dtype=torch.float64),
        action_names=("voltage",),
        initial_readings=position[:1, None],
        initial_values=position[:1, None],
        initial_rates=read_rate.reshape(1, 1),
        channel_names=("position",),
        past_actions=torch.full((1, 8, 1), fall, dtype=torch.float64),
        time_step=Emps.time_step,
        mask=torch.ones(1, 40, dtype=torch.bool),
        rollout=torch.zeros(1, dtype=torch.long),
        start=torch.tensor([begin]),
    )
    simulator = Emps(integrator="constant-acceleration").with_effects(effect)
    given = FREE | {effect.parameter_names[0]: value}
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in given.items()}
    out = simulator.simulate(given, inputs)[0]
    # Between steps positions are taken as linear, which is off by a h²/8 at most.
    torch.testing.assert_close(
        out[:, 0], position[1:], rtol=0.0, atol=fall * Emps.time_step**2 / 8.0
    )
    if effect.id != "clock_skew":  # which the velocity's reading has as well
        torch.testing.assert_close(out[:, 1], fall * time[1:])


class _LooksBack(SensorEffect):
    """Reads the change of the value in the step before the segment, at its first reading."""

    id = "looks_back"
    needs_past = True
    parameters = ()

    def default_priors(self, port):
        return {}

    def history(self, parameters, time_step):
        return 2

    def initial_memory(self, value, reading, start):
        return start.changes[0]

    def read(self, value, parameters, memory, time_step):
        return memory, memory


def test_effects_that_need_the_past_get_it_where_nothing_is_late():
    simulator = Pendulum(integrator="rk4").with_effects(_LooksBack("angle"))
    out = replay(simulator, {}, [0.0], start=[1.0, 0.5], step=20)
    short = replay(Pendulum(integrator="rk4"), {}, [0.0], start=[1.0, 0.5], time_step=1e-4)
    step, acceleration = Pendulum.time_step, float(short[0, 1] - 0.5) / 1e-4
    expected = -0.5 * step + 0.5 * acceleration * step**2
    assert float(out[0, 0]) == pytest.approx(expected, rel=0.01)


def test_a_closed_loop_reads_late():
    simulator = Emps().with_effects(SensorDelay("position"))
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in FREE.items()}
    given["position.sensor_delay.delay"] = torch.tensor(0.0107, dtype=torch.float64)
    policy = Linear(("position", "velocity"), ("voltage",))
    policy.parameters = torch.zeros_like(policy.parameters).double()
    start = torch.tensor([[0.1, 0.5]], dtype=torch.float64)
    episode = simulator.roll_out(given, policy, start, 40, record=True)
    ramp = 0.1 + 0.5 * (Emps.time_step * torch.arange(1, 41, dtype=torch.float64) - 0.0107)
    torch.testing.assert_close(episode.readings[0, 1:, 0], ramp, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("skew", [0.0, 1e-3, -2e-3])
def test_a_skewed_clock_reads_the_parabola_of_a_falling_body_early_or_late(skew):
    simulator = Emps(integrator="constant-acceleration").with_effects(ClockSkew("clock"))
    step, acceleration = 2000, 3.0
    time = Emps.time_step * torch.arange(step, step + 60, dtype=torch.float64)
    stamped = time * (1.0 + skew)
    truth = torch.stack(
        (0.5 * acceleration * (stamped - 2.0) ** 2, acceleration * (stamped - 2.0)), -1
    )
    out = replay(
        simulator,
        FREE | {"clock.clock_skew.skew": skew},
        [acceleration] * 59,
        truth[0].tolist(),
        step,
    )
    torch.testing.assert_close(out, truth[1:], rtol=0.0, atol=1e-10)


def test_a_wave_in_time_is_that_of_the_middle_of_a_step():
    # A force of the step's start would be late by 10 ms, which is 0.13 rad of this wave's phase.
    wave = PeriodicDisturbance("hinge")
    names = "sine", "cosine", "frequency"
    strength = {
        f"{wave.name}.{name}": torch.tensor(value, dtype=torch.float64)
        for name, value in zip(names, (0.5, 0.3, 2.0), strict=True)
    }
    still = Inputs.single(
        torch.zeros(100, 1, dtype=torch.float64),
        torch.zeros(2, dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=0.02,
    )
    coarse, fine = (
        Pendulum(integrator="rk4", substeps=n).with_effects(wave).simulate(strength, still)
        for n in (1, 32)
    )
    assert (coarse - fine).norm() < 0.02 * fine.norm()


def test_a_clock_ahead_continues_the_last_steps_parabola():
    clock, h = ClockSkew("clock"), 0.02
    skew = {"skew": torch.tensor(1e-3, dtype=torch.float64)}
    ahead = 5.0 * 1e-3 / h  # in steps, at 5 s
    one, four = (torch.tensor(x, dtype=torch.float64) for x in (1.0, 4.0))
    start = Start(torch.tensor(5.0 - h, dtype=torch.float64), h, skew)
    memory = clock.initial_memory(one, one, start)
    for bend, expected in ((0.0, 4.0 + 3.0 * ahead), (-1.0, (2.0 + ahead) ** 2)):
        reading, _ = clock.read_bent(four, torch.tensor(bend), skew, memory, h)
        assert float(reading) == pytest.approx(expected, rel=1e-9)
