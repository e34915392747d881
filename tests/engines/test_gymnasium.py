"""Environments as simulators: their dynamics against the environment itself and against ours."""

import doctest
import importlib
import math
import pickle
import sys

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.gymnasium import Attribute
from npdr_ppl.errors import DataError, DependencyError, ModelError
from npdr_ppl.language.channels import Channel, Parameter
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.models.effects import EncoderBias, InputDelay
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra `gymnasium`")

ANGLE = Channel("angle", "rad")
VELOCITY = Channel("velocity", "rad/s", rate_of="angle")


@pytest.fixture(scope="module", autouse=True)
def one_worker():
    """Keeps one process for all tests that do not ask for others."""
    with npdr.workers("serial") as used:
        yield used


def pendulum(**changed):
    options = {
        "parameters": {
            "mass": Attribute("m", "kg"),
            "length": Attribute("l", "m"),
            "gravity": Attribute("g", "m/s²"),
        },
        "states": (ANGLE, VELOCITY),
        "set_state": "state",
        "actions": (Channel("torque", "N m"),),
    }
    return npdr.GymnasiumSimulator("Pendulum-v1", **{**options, **changed})


def set_cart_pole(environment, values):
    """Sums and products of its parameters are kept from the environment's making."""
    environment.masscart, environment.masspole = values["cart_mass"], values["pole_mass"]
    environment.length = values["half_length"]
    environment.total_mass = values["cart_mass"] + values["pole_mass"]
    environment.polemass_length = values["pole_mass"] * values["half_length"]


def push(environment, commands):
    """The environment knows two actions, and how strong they are."""
    environment.force_mag = abs(commands[0])
    return int(commands[0] > 0)


CART_POLE_STATES = (
    Channel("position", "m"), Channel("velocity", "m/s", rate_of="position"),
    Channel("angle", "rad"), Channel("spin", "rad/s", rate_of="angle"),
)  # fmt: skip


def cart_pole(**changed):
    options = {
        "parameters": {
            "cart_mass": Parameter("cart_mass", "kg", 1.0),
            "pole_mass": Parameter("pole_mass", "kg", 0.1),
            "half_length": Parameter("half_length", "m", 0.5),
            "gravity": Attribute("gravity", "m/s²"),
        },
        "set_parameters": set_cart_pole,
        "states": CART_POLE_STATES,
        "set_state": "state",
        "actions": (Channel("force", "N", -20.0, 20.0),),
        "act": push,
        "time_step": 0.02,
    }
    return npdr.GymnasiumSimulator("CartPole-v1", **{**options, **changed})


def inputs(simulator, commands, start):
    return Inputs.single(
        torch.as_tensor(commands)[:, None], torch.tensor(start, dtype=torch.float64),
        action_names=tuple(a.name for a in simulator.actions),
        state_names=tuple(s.name for s in simulator.states),
        time_step=simulator.time_step, history=4,
    )  # fmt: skip


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_channels_and_nominal_values_are_the_environments():
    simulator = pendulum()
    assert [p.nominal for p in simulator.parameters] == [1.0, 1.0, 10.0]
    assert simulator.time_step == 0.05
    assert simulator.actions == (Channel("torque", "N m", -2.0, 2.0),)
    assert simulator.port("torque").rated == 2.0
    plain = npdr.GymnasiumSimulator("Pendulum-v1")
    assert [s.name for s in plain.sensors] == [f"observation_{i}" for i in range(3)]
    assert plain.name == "GymnasiumSimulator(Pendulum-v1)"
    assert plain.recorded_settings()["environment"] == "Pendulum-v1"


@pytest.mark.slow
def test_trajectories_are_the_environments_own():
    simulator = pendulum()
    commands = 2.5 * np.sin(0.4 * np.arange(50))
    masses = doubles(0.7, 1.0, 1.4)
    found = simulator.simulate({"mass": masses}, inputs(simulator, commands, [2.0, 0.3]))
    for mass, trajectory in zip(masses.tolist(), found[:, 0].numpy(), strict=True):
        environment = gymnasium.make("Pendulum-v1").unwrapped
        environment.m, environment.state = mass, np.array([2.0, 0.3])
        for command, row in zip(commands, trajectory, strict=True):
            environment.step(np.clip([command], -2, 2).astype(np.float32))
            np.testing.assert_array_equal(row, environment.state)


def test_the_pendulum_is_the_zoos_upside_down():
    # It limits the velocity to 8 rad/s, and 0 is upright.
    simulator = pendulum()
    commands = 1.5 * np.sin(0.3 * np.arange(40))
    parameters = {"mass": doubles(1.2)[0], "length": doubles(0.9)[0]}
    found = simulator.simulate(parameters, inputs(simulator, commands, [math.pi + 0.4, 0.0]))
    zoo = Pendulum(compile="never")
    parameters |= {"gravity": doubles(10.0)[0]}
    given = Inputs.single(
        torch.as_tensor(commands)[:, None], doubles(0.4, 0.0), action_names=("torque",),
        state_names=("angle", "velocity"), time_step=0.05,
    )  # fmt: skip
    expected = zoo.simulate(parameters, given)
    expected[..., 0] += math.pi
    # Actions are float32 in the environment.
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_cart_pole_takes_forces_and_goes_on_after_it_has_fallen():
    simulator = cart_pole()
    commands = 8.0 * np.sin(0.2 * np.arange(150))
    parameters = {"cart_mass": doubles(1.3)[0], "half_length": doubles(0.4)[0]}
    start = [0.0, 0.1, 0.3, -0.2]
    found = simulator.simulate(parameters, inputs(simulator, commands, start))[0].numpy()
    assert abs(found[-1, 2]) > math.pi / 2
    # A uniform pole on a hinge, by the mass matrix instead of the solved equations.
    x, v, angle, spin = start
    cart, pole, half, g, h = 1.3, 0.1, 0.4, 9.8, 0.02
    for command, row in zip(commands, found, strict=True):
        inertia = np.array([
            [cart + pole, pole * half * math.cos(angle)],
            [pole * half * math.cos(angle), 4 / 3 * pole * half**2],
        ])  # fmt: skip
        force = np.array([
            command + pole * half * spin**2 * math.sin(angle),
            pole * g * half * math.sin(angle),
        ])  # fmt: skip
        acceleration, turning = np.linalg.solve(inertia, force)
        x, angle = x + h * v, angle + h * spin
        v, spin = v + h * acceleration, spin + h * turning
        np.testing.assert_allclose(row, [x, v, angle, spin], rtol=1e-9, atol=1e-9)
    assert CartPole.time_step  # the zoo's own has a track with friction, and another actuator


def test_effects_act_on_commands_and_readings():
    simulator = pendulum().with_effects(InputDelay("torque"), EncoderBias("angle"))
    commands = np.sin(0.5 * np.arange(20))
    given = inputs(simulator, commands, [1.1, 0.0])
    parameters = {
        "torque.input_delay.delay": doubles(0.1)[0],
        "angle.encoder_bias.offset": doubles(0.1)[0],
    }
    found = simulator.simulate(parameters, given)[0]
    late = np.concatenate([np.zeros(2), commands[:-2]])
    expected = pendulum().simulate({}, inputs(simulator, late, [1.0, 0.0]))[0]
    expected[:, 0] += 0.1
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_policies_run_in_environments():
    policy = Linear(("angle", "velocity"), ("torque",))
    policy = policy.with_parameters(torch.tensor([-10.0, -3.0, 0.0]))
    simulator = pendulum()
    starts = doubles([0.15, 0.0], [-0.1, 0.2])
    reward = lambda positions, velocities, commands: -positions[0].square()  # noqa: E731
    out = simulator.roll_out({}, policy, starts, 60, reward=reward, record=True)
    assert float(out.readings[:, -20:, 0].abs().max()) < 0.02
    torch.testing.assert_close(out.readings[:, 0], starts)
    replayed = simulator.simulate({}, inputs(simulator, out.commands[0, :, 0], starts[0].tolist()))
    torch.testing.assert_close(out.readings[0, 1:], replayed[0])


def make_hanging():
    """An inverted pendulum of MuJoCo's, made by a function."""
    return gymnasium.make("InvertedPendulum-v5", max_episode_steps=-1)


def read_positions_and_velocities(environment, observation):
    return np.concatenate([environment.data.qpos, environment.data.qvel])


def put_positions_and_velocities(environment, state):
    environment.set_state(state[:2], state[2:])


def test_a_mujoco_environment_agrees_with_its_own_file():
    pytest.importorskip("imageio", reason="needs gymnasium[mujoco]")
    simulator = npdr.GymnasiumSimulator(
        make_hanging,
        parameters={
            "friction": Attribute("model.dof_damping[1]", "N m s/rad"),
            "gravity": Attribute("model.opt.gravity[2]", "m/s²"),
        },
        states=(
            Channel("slider", "m"), Channel("hinge", "rad"),
            Channel("slider_velocity", "m/s", rate_of="slider"),
            Channel("hinge_velocity", "rad/s", rate_of="hinge"),
        ),
        set_state=put_positions_and_velocities,
        read=read_positions_and_velocities,
        actions=(Channel("slide", "1"),),
    )  # fmt: skip
    environment = make_hanging()
    twin = npdr.MujocoSimulator(
        environment.unwrapped.fullpath,
        {"friction": "joint hinge damping"},
        time_step=simulator.time_step,
        substeps=environment.unwrapped.frame_skip,
    )
    environment.close()
    commands = 2.0 * np.sin(0.3 * np.arange(40))
    parameters = {"friction": doubles(0.1, 1.5)}
    start = [0.0, 0.2, 0.0, 0.0]
    found = simulator.simulate(parameters, inputs(simulator, commands, start))
    expected = twin.simulate(parameters, inputs(twin, commands, start))
    # Actions are float32 in the environment.
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_an_environment_is_a_site_of_a_model():
    simulator = pendulum()
    given = inputs(simulator, np.ones(10), [0.5, 0.0])

    def model(inputs):
        mass = pyro.sample("mass", dist.Uniform(0.5, 2.0))
        return npdr.simulate("trajectory", simulator, {"mass": mass}, inputs)

    draws = pyro.infer.Predictive(model, num_samples=4, parallel=True)(given)
    assert draws["trajectory"].shape == (4, 1, 10, 2)


def test_results_do_not_depend_on_what_ran_before():
    simulator = cart_pole()
    given = inputs(simulator, np.ones(10), [0.0, 0.0, 0.1, 0.0])
    masses = doubles(0.5, 1.0, 2.0)
    together = simulator.simulate({"cart_mass": masses}, given)
    backwards = simulator.simulate({"cart_mass": masses.flip(0)}, given)
    assert torch.equal(together, backwards.flip(0))
    assert torch.equal(simulator.simulate({}, given), together[1])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"parameters": {"mass": Attribute("mass")}}, "nothing at 'mass': PendulumEnv has no"),
        ({"parameters": {"mass": Attribute("m..x")}}, "no path of attributes"),
        ({"parameters": {"mass": Attribute("state")}}, "'mass' is a number"),
        ({"parameters": {"mass": Parameter("mass", "kg", 1.0)}}, "need a set_parameters"),
        ({"parameters": {"mass": Parameter("m", "kg", 1.0)}}, "'m' is given as 'mass'"),
        ({"set_state": None}, "give set_state"),
        ({"sensors": (ANGLE,), "read": "state"}, r"1 sensors.*shape \(2,\)"),
        (
            {"read": lambda observation: observation},
            "environment and an observation; yours",
        ),
        ({"set_state": lambda state: None}, "set_state is .* environment and a state"),
        ({"actions": (ANGLE, VELOCITY)}, "1 actions, but 2 were named"),
        ({"rated": {"force": 1.0}}, "force names no channel"),
        ({"actions": (Channel("angle", "N m"),)}, "angle names two channels"),
    ],
)
def test_mistakes_are_one_sentence(changed, words):
    with pytest.raises(ModelError, match=words):
        pendulum(**changed)


def test_an_id_that_only_one_process_knows_is_made_by_others():
    """Own environments are registered by the file that the main process imports."""
    gymnasium.register("OwnPendulum-v0", "gymnasium.envs.classic_control.pendulum:PendulumEnv")
    own = npdr.GymnasiumSimulator("OwnPendulum-v0")
    sent = pickle.dumps(own)
    del gymnasium.registry["OwnPendulum-v0"]
    again = pickle.loads(sent)
    given = inputs(again, np.ones(5), [])
    assert torch.equal(own.simulate({}, given), again.simulate({}, given))


def test_what_environments_cannot_do_is_said():
    with pytest.raises(ModelError, match="Discrete.*give an act"):
        cart_pole(act=None)
    with pytest.raises(ModelError, match="how long a step is"):
        cart_pole(time_step=None)
    with pytest.raises(ModelError, match="cannot make 'Pendulo-v1'"):
        npdr.GymnasiumSimulator("Pendulo-v1")
    with pytest.raises(ModelError, match="an id or a function"):
        npdr.GymnasiumSimulator(gymnasium.make("Pendulum-v1"))
    other = Inputs.single(
        torch.zeros(3, 1), torch.zeros(2), action_names=("torque",),
        state_names=("angle", "velocity"), time_step=0.02,
    )  # fmt: skip
    with pytest.raises(DataError, match=r"steps of 0\.05 s, but 0\.02 s"):
        pendulum().simulate({}, other)


def test_absent_gymnasium_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(DependencyError, match=r"npdr-ppl\[gymnasium\]"):
        npdr.GymnasiumSimulator("Pendulum-v1")


def test_the_example_runs():
    found = doctest.testmod(importlib.import_module("npdr_ppl.engines.gymnasium.simulator"))
    assert found.attempted > 0
    assert found.failed == 0
