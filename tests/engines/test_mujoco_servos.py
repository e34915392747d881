"""Effects inside servos in MuJoCo, against the engine's own numbers and loops written out here."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from pyro.distributions import Normal

import npdr_ppl as npdr
from npdr_ppl.discovery.screening.probes import probe_of
from npdr_ppl.discovery.screening.settings import SENSITIVITY
from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.effects import ServoEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    GoalAccelerationLimit,
    GoalResolution,
    GoalSpeedLimit,
    InputDelay,
    IntegralAction,
    Saturation,
    SensorDelay,
    ServoDeadBand,
    ServoForceLimit,
    candidate_effects,
)
from npdr_ppl.policies.playback import Playback
from tests.helpers.effect_replay import replay
from tests.helpers.mujoco_files import random_inputs, value

STEP, GAIN, DAMPING = 0.002, 20.0, 1.0

SERVO = '<position name="goal" joint="hinge" kp="{kp}" kv="{kv}" {more}/>'


def joint(actuator=SERVO, more="", kp=GAIN, kv=DAMPING):
    actuator = actuator.format(kp=kp, kv=kv, more=more)
    text = f"""<mujoco><option timestep="{STEP}"/><worldbody>
    <body><joint name="hinge" axis="0 1 0" armature="0.02" range="-120 120"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/></body></worldbody>
    <actuator>{actuator}</actuator></mujoco>"""
    return MujocoSimulator(mujoco.MjModel.from_xml_string(text))


def goals(commands, first=0.0):
    """Inputs with commands from rest at the first position."""
    commands = torch.as_tensor(np.asarray(commands), dtype=torch.float64)
    return Inputs.single(
        commands[:, None],
        value([first, 0.0]),
        action_names=("goal",),
        state_names=("hinge", "hinge_velocity"),
        time_step=STEP,
    )


def written_out(law, commands, position=0.0):
    """Positions of a joint whose servo is a law, one engine step after another."""
    model = joint('<motor name="goal" joint="hinge"/>').model
    data = mujoco.MjData(model)
    data.qpos[0] = position
    result = []
    for command in commands:
        mujoco.mj_forward(model, data)
        data.qfrc_applied[0] = law(command - data.qpos[0], data.qvel[0])
        mujoco.mj_step(model, data)
        result.append(float(data.qpos[0]))
    return torch.tensor(result, dtype=torch.float64)


def test_a_dead_band_takes_the_force_of_small_errors():
    inputs = random_inputs(joint(), num_steps=150)
    base = joint().simulate({}, inputs)
    width = 0.05
    effect = ServoDeadBand("goal")
    out = (
        joint().with_effects(effect).simulate({f"{effect.name}.width": value([0, width])}, inputs)
    )
    assert torch.equal(out[0], base)
    commands = 0.4 * np.sin(np.linspace(0.0, 9.0, 300))
    given = {f"{effect.name}.width": value(width)}
    (reached,) = joint().with_effects(effect).simulate(given, goals(commands))

    def law(error, velocity):
        acted = math.copysign(max(abs(error) - width, 0.0), error)
        return GAIN * acted - DAMPING * velocity

    torch.testing.assert_close(reached[:, 0], written_out(law, commands), atol=1e-12, rtol=0.0)


def test_a_saturated_servo_loses_nothing_by_a_dead_band():
    effects = ServoDeadBand("goal"), ServoForceLimit("goal")
    limit, width, commands = 1.0, 0.04, np.full(200, 2.0)
    given = {"goal.servo_dead_band.width": value(width)}
    given["goal.servo_force_limit.limit"] = value(limit)
    (reached,) = joint().with_effects(*effects).simulate(given, goals(commands))

    def law(error, velocity):
        acted = math.copysign(max(abs(error) - width, 0.0), error)
        return min(max(GAIN * acted - DAMPING * velocity, -limit), limit)

    expected = written_out(law, commands)
    torch.testing.assert_close(reached[:, 0], expected, atol=1e-12, rtol=0.0)


INTEGRAL = {"rate": 4.0, "limit": 0.03}


def summed_up(commands, rate, limit, load=0.0):
    """Positions of a joint whose servo has integral action with clamping, written out."""
    integral = 0.0

    def law(error, velocity):
        nonlocal integral
        middle = min(max(integral + 0.5 * STEP * rate * error, -limit), limit)
        mean = error - 0.5 * STEP * velocity
        integral = min(max(integral + STEP * rate * mean, -limit), limit)
        return GAIN * (error + middle) - DAMPING * velocity + load

    return written_out(law, commands)


@pytest.mark.parametrize("limit", [math.inf, 0.03])
def test_integral_action_sums_up_the_error_up_to_its_limit(limit):
    effect = IntegralAction("goal")
    commands = np.r_[np.zeros(20), np.full(200, 0.3), np.full(200, -0.1)]
    given = {f"{effect.name}.{name}": value([0.0, own]) for name, own in INTEGRAL.items()}
    given[f"{effect.name}.limit"] = value([0.03, limit])
    out = joint().with_effects(effect).simulate(given, goals(commands))
    assert torch.equal(out[0], joint().simulate({}, goals(commands)))
    expected = summed_up(commands, INTEGRAL["rate"], limit)
    torch.testing.assert_close(out[1, 0, :, 0], expected, atol=1e-12, rtol=0.0)
    other = summed_up(commands, INTEGRAL["rate"], {math.inf: 0.03, 0.03: math.inf}[limit])
    assert float((expected - other).abs().max()) > 1e-3


class SlowError(ServoEffect):
    """A servo that acts on its error behind a low-pass."""

    id = "slow_error"
    parameters = (Parameter("bandwidth", "1/s", 0.0, "inverse of its time constant"),)

    def default_priors(self, port):
        return {"bandwidth": Normal(0.0, 1.0)}

    def initial_memory(self, error):
        return error

    def act(self, error, parameters, memory):
        return memory

    def next_memory(self, error, parameters, memory, time_step):
        return error + (memory - error) * torch.exp(-time_step * parameters["bandwidth"])


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        (IntegralAction("goal"), {"rate": 4.0, "limit": math.inf}),
        (SlowError("goal"), {"bandwidth": 30.0}),
        (ServoDeadBand("goal"), {"width": 0.04}),
    ],
)
def test_servos_are_right_to_second_order(effect, values):
    """Half as long steps have at most about a quarter of the error."""
    given = {f"{effect.name}.{name}": value(own) for name, own in values.items()}
    model = joint().model
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    commands = np.r_[np.full(100, 0.3), np.full(100, -0.1)]

    def moved(substeps):
        simulator = MujocoSimulator(model, substeps=substeps, time_step=4 * STEP)
        inputs = replace(goals(commands), time_step=4 * STEP)
        return simulator.with_effects(effect).simulate(given, inputs)[0, :, 0]

    exact = moved(64)
    errors = [float((moved(number) - exact).abs().max()) for number in (4, 8)]
    assert errors[0] > 3.0 * errors[1]
    assert errors[0] < 1e-3


@pytest.mark.parametrize("more", [(), (ServoDeadBand("goal"),)])
def test_the_integral_of_a_running_rollout_is_known_from_the_recording(more):
    """A segment that begins later continues the sum, with its limit, over the whole past.

    After a dead band, the sum is that of the errors beyond it.
    """
    effect = IntegralAction("goal")
    simulator = joint().with_effects(*more, effect)
    given = {f"{effect.name}.{name}": value(own) for name, own in INTEGRAL.items()}
    given |= {f"{band.name}.width": value(0.02) for band in more}
    commands = 0.3 * np.sin(np.linspace(0.0, 20.0, 4000)) + 0.2
    (whole,) = simulator.simulate(given, goals(commands))
    rollouts = npdr.Rollouts.from_arrays(
        readings=[torch.cat((value([[0.0, 0.0]]), whole))],
        actions=[commands[:, None]],
        channel_names=["hinge", "hinge_velocity"],
        action_names=["goal"],
        time_step=STEP,
    )
    cut = rollouts.inputs(segment_length=500, initial_state="recorded", history=64)
    parts = simulator.simulate(given, cut)
    assert cut.num_segments == 8
    # The same within the curvature of the motion between two measurements.
    torch.testing.assert_close(parts.flatten(0, 1)[:, 0], whole[:, 0], atol=2e-5, rtol=0.0)
    forgotten = simulator.simulate(given, replace(cut, recorded_actions=None))
    assert float((forgotten.flatten(0, 1) - whole)[:, 0].abs().max()) > 0.01
    # Likewise with four engine steps in each of the recording's.
    finer = simulator.with_finer_steps().with_finer_steps()
    (whole,) = finer.simulate(given, goals(commands))
    cut = replace(cut, recorded_readings=torch.cat((value([[0.0, 0.0]]), whole[:-1]))[None])
    starts = torch.cat((value([[0.0, 0.0]]), whole))[cut.start]
    cut = replace(cut, initial_readings=starts, initial_values=starts)
    parts = finer.simulate(given, cut)
    torch.testing.assert_close(parts.flatten(0, 1)[:, 0], whole[:, 0], atol=1e-5, rtol=0.0)
    # A batch of draws has the same states, whatever the chunk.
    several = {name: own.expand(3) for name, own in given.items()}
    torch.testing.assert_close(finer.simulate(several, cut)[1], parts)


def test_a_servo_with_a_state_begins_a_rollout_at_its_goal():
    simulator = joint().with_effects(SlowError("goal"))
    given = {"goal.slow_error.bandwidth": value(1.0)}
    moved = simulator.simulate(given, goals(np.full(2, 0.4), 0.4)) - value([0.4, 0.0])
    fallen = joint('<motor name="goal" joint="hinge"/>').simulate({}, goals([0.0], 0.4))
    torch.testing.assert_close(moved[:, :1], fallen - value([0.4, 0.0]), atol=1e-4, rtol=0.0)


def test_a_force_limit_is_that_of_the_file():
    limited = joint(more='forcerange="-0.7 0.7"')
    inputs = random_inputs(joint(), num_steps=150)
    name = "goal.servo_force_limit.limit"
    changed = joint().with_effects(ServoForceLimit("goal"))
    out = changed.simulate({name: value([math.inf, 0.7])}, inputs)
    assert torch.equal(out[0], joint().simulate({}, inputs))
    assert torch.equal(out[1], limited.simulate({}, inputs))
    assert float((out[0] - out[1]).abs().max()) > 0.01
    asymmetric = joint(more='forcerange="-0.3 2"')
    inputs_of_it = random_inputs(asymmetric, num_steps=150)
    kept = asymmetric.with_effects(ServoForceLimit("goal")).simulate({}, inputs_of_it)
    assert torch.equal(kept, asymmetric.simulate({}, inputs_of_it))
    # The lower one of both limits acts.
    both = limited.with_effects(ServoForceLimit("goal")).simulate(
        {name: value([0.4, 2.0])}, inputs
    )
    assert torch.equal(both[1], out[1])
    assert float((both[0] - out[1]).abs().max()) > 0.01


@pytest.mark.parametrize("effect", [GoalSpeedLimit("goal"), GoalAccelerationLimit("goal")])
def test_an_infinite_limit_changes_nothing(effect):
    inputs = random_inputs(joint(), num_steps=100)
    out = joint().with_effects(effect).simulate({f"{effect.name}.limit": value(math.inf)}, inputs)
    assert torch.equal(out, joint().simulate({}, inputs))
    assert torch.equal(joint().with_effects(effect).simulate({}, inputs), out)


def test_a_goal_with_limited_speed_is_a_ramp():
    speed, step = 2.0, 0.3
    # The mean of each step acts.
    ramp = np.minimum(step, speed * STEP * (np.arange(200) + 0.5))
    limited = joint().with_effects(GoalSpeedLimit("goal"))
    inputs = goals(np.r_[np.zeros(10), np.full(200, step)])
    out = limited.simulate({"goal.goal_speed_limit.limit": value(speed)}, inputs)
    expected = joint().simulate({}, goals(np.r_[np.zeros(10), ramp]))
    torch.testing.assert_close(out, expected, atol=1e-12, rtol=0.0)


def test_a_goal_with_limited_acceleration_arrives_in_the_shortest_time():
    acceleration, step, first = 4.0, 0.25, 10
    law = GoalAccelerationLimit("goal")
    memory, path = law.initial_memory(value([0.0]), None), []

    class Now:
        def __init__(self, command):
            self.command = value([command])

        def now(self):
            return self.command

    for command in np.r_[np.zeros(first), np.full(400, step)]:
        goal, memory = law.act(Now(command), {"limit": value(acceleration)}, memory, STEP)
        assert path == [] or path[-1] <= float(goal.mean) <= float(memory[0])
        path.append(float(memory[0]))
    speeds = np.diff(path) / STEP
    assert np.abs(np.diff(speeds)).max() <= acceleration * STEP * (1.0 + 1e-9)
    assert max(path) == step == path[-1]
    arrival = STEP * (int(np.argmax(np.asarray(path) == step)) + 1 - first)
    assert arrival == pytest.approx(2.0 * math.sqrt(step / acceleration), abs=4 * STEP)


def test_the_goal_of_a_running_rollout_is_known_from_the_past():
    """A segment that begins while a slow goal is under way continues it."""
    commands = np.r_[np.zeros(20), np.full(600, 0.5)]
    limited = joint().with_effects(GoalSpeedLimit("goal"))
    given = {"goal.goal_speed_limit.limit": value(0.6)}
    (whole,) = limited.simulate(given, goals(commands))
    first = 200
    begun = goals(commands[first:])
    later = replace(
        begun,
        initial_readings=whole[first - 1][None],
        initial_values=whole[first - 1][None],
        past_actions=torch.tensor(commands)[None, :first, None],
        start=torch.tensor([first]),
    )
    (part,) = limited.simulate(given, later)
    torch.testing.assert_close(part, whole[first:], atol=1e-12, rtol=0.0)


def test_a_servo_holds_its_first_goal_before_the_rollout():
    commands = np.full(100, 0.4)
    late = joint().with_effects(InputDelay("goal"))
    out = late.simulate({"goal.input_delay.delay": value([0.0, 0.02])}, goals(commands, 0.4))
    assert torch.equal(out[0], out[1])


def test_a_coarse_goal_is_a_multiple_of_its_step():
    commands = np.linspace(-0.5, 0.5, 100)
    coarse = joint().with_effects(GoalResolution("goal"))
    given = {"goal.goal_resolution.step": value([0.0, 0.07])}
    out = coarse.simulate(given, goals(commands))
    assert torch.equal(out[0], joint().simulate({}, goals(commands)))
    rounded = 0.07 * np.round(commands / 0.07)
    torch.testing.assert_close(out[1], joint().simulate({}, goals(rounded)))


def test_late_sensors_of_a_servo_that_damps_within_a_step_start_where_the_joint_is():
    """Its motion decays at 1700 per second: explicit steps of 2 ms would blow it up."""
    simulator = joint(kp=1000.0, kv=100.0).with_finer_steps()
    late = simulator.with_effects(SensorDelay("hinge,hinge_velocity"))
    given = {"hinge,hinge_velocity.sensor_delay.delay": 0.0107}
    begin, num = 60, 40
    time = STEP * torch.arange(begin + num, dtype=torch.float64)
    commands = 0.3 * torch.sin(5.0 * time) + 0.1 * torch.sign(torch.sin(23.0 * time))
    whole = replay(late, given, commands)
    start = whole[begin - 1].tolist()
    out = replay(late, given, commands[begin:], start, begin, commands[None, :begin, None])
    assert (whole[-1] - whole[begin]).abs().max() > 0.1
    error = (out - whole[begin:]).abs()
    assert error[:, 0].max() < 3e-5 and error[:, 1].max() < 0.03 * whole[begin:, 1].abs().max()


@pytest.mark.parametrize("share", [0.3, 1.4, 5.4])
@pytest.mark.parametrize(("kp", "kv"), [(GAIN, DAMPING), (1000.0, 100.0)])
def test_late_positions_alone_are_read_on_their_own_parabola(kp, kv, share):
    """No sensor shows the rate; the bend of a step needs the positions of the two before it."""
    given = joint(kp=kp, kv=kv)
    both = given.with_finer_steps()
    alone = MujocoSimulator(given.model, sensors=["hinge"]).with_finer_steps()
    begin, num, delay = 60, 20, share * STEP
    commands = 0.3 * torch.sin(5.0 * STEP * torch.arange(begin + num, dtype=torch.float64))
    late = both.with_effects(SensorDelay("hinge,hinge_velocity"))
    whole = replay(late, {"hinge,hinge_velocity.sensor_delay.delay": delay}, commands)
    position, rate = whole[begin - 1]
    inputs = Inputs.single(
        commands[begin:, None],
        position[None],
        action_names=("goal",),
        state_names=("hinge",),
        time_step=STEP,
    )
    inputs = replace(
        inputs,
        start=torch.tensor([begin]),
        initial_rates=rate[None, None],
        past_actions=commands[None, :begin, None],
    )
    parameters = {"hinge.sensor_delay.delay": torch.tensor(delay).double()}
    out = alone.with_effects(SensorDelay("hinge")).simulate(parameters, inputs)[0, :, 0]
    assert (out - whole[begin:, 0]).abs().max() < 1e-5


def test_laws_of_goals_need_a_servo_that_follows_its_joint():
    names = {effect.name for effect in candidate_effects(joint())}
    assert {"goal.servo_dead_band", "goal.servo_force_limit", "goal.goal_speed_limit"} < names
    geared = joint(more='gear="3"')
    names = {effect.name for effect in candidate_effects(geared)}
    assert "goal.servo_force_limit" in names
    assert "goal.servo_dead_band" not in names
    with pytest.raises(ModelError, match="makes no sense"):
        geared.with_effects(ServoDeadBand("goal"))
    port = joint().port("goal")
    assert port.force_unit == "N m"
    assert ServoForceLimit("goal").units(port) == {"limit": "N m"}


def test_an_episode_and_the_replay_of_its_commands_are_the_same():
    slow = joint().with_effects(GoalSpeedLimit("goal"))
    given = {"goal.goal_speed_limit.limit": value(1.0)}
    commands = np.r_[np.full(40, 0.5), np.full(60, -0.2)]
    policy = Playback(value(commands[:, None]), ("goal",), STEP)
    episodes = slow.roll_out(given, policy, value([0.1, 0.0]), len(commands), record=True)
    (replayed,) = slow.simulate(given, goals(commands, 0.1))
    torch.testing.assert_close(episodes.readings[1:], replayed, atol=1e-12, rtol=0.0)


def test_a_filtered_servo_has_no_dead_band():
    filtered = joint(more='timeconst="0.1"')
    with pytest.raises(ModelError, match="without a filter"):
        filtered.with_effects(ServoDeadBand("goal"))


def test_integral_action_is_tried_at_typical_rates():
    given = IntegralAction("goal").probe(joint().port("goal"))["rate"]
    tried = probe_of(IntegralAction("goal"), goals(np.zeros(10)), joint(), None)
    assert {run["rate"] for run in tried.runs} == {size * given for size in SENSITIVITY.sizes}


def test_limits_are_tried_below_what_they_would_cut_off():
    simulator = joint()
    inputs = goals(0.5 * np.sin(np.linspace(0.0, 9.0, 100)))
    force = probe_of(ServoForceLimit("goal"), inputs, simulator, None)
    limits = [values["limit"] for values, _, _ in force.cases]
    assert limits == sorted(limits, reverse=True)
    assert len(limits) == len(SENSITIVITY.limit_quantiles)
    assert [float(zero) * SENSITIVITY.first_limit for zero in force.nominal] == pytest.approx(
        limits
    )
    clipped = probe_of(Saturation("goal"), inputs, simulator, None)
    peak = float(inputs.actions.abs().max())
    assert {values["limit"] for values, _, _ in clipped.cases} == {SENSITIVITY.first_limit * peak}
