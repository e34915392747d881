"""Closed loop in simulators on workers: the engine's episodes are those of a loop written out."""

from dataclasses import replace

import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.pooled.stepped_simulator import SteppedSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import Domains
from npdr_ppl.loop.policy_optimisation import optimise_policy
from npdr_ppl.models.effects import EncoderBias, InputDelay, ViscousFriction
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.policies.linear import Linear
from npdr_ppl.policies.mppi import MPPI
from npdr_ppl.policies.playback import Playback
from npdr_ppl.policies.search_registry import policy_search
from tests.helpers.bullet_models import bullet_pendulum, pendulum_urdf


@pytest.fixture(scope="module", autouse=True)
def one_worker():
    """Keeps one process for all tests that do not ask for others."""
    with npdr.workers("serial") as used:
        yield used


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    return pendulum_urdf(tmp_path_factory.mktemp("pendulum"))


class _Cart:
    """Semi-implicit Euler on a mass that is pushed."""

    def __init__(self, mass, segment, noise):
        self.velocity, self.position = segment.initial_state
        self.mass, self.segment, self.noise = mass, segment, noise

    def read(self):
        return [self.position, self.velocity]

    def advance(self, step):
        push = self.segment.actions[step, 0] + self.noise
        self.velocity += self.segment.time_step * push / self.mass
        self.position += self.segment.time_step * self.velocity


class Cart(SteppedSimulator):
    """States in the other order than rewards are given them."""

    states = (Channel("velocity", "m/s", -5.0, 5.0, rate_of="position"), Channel("position", "m"))
    sensors = tuple(reversed(states))
    actions = (Channel("push", "N", -3.0, 3.0),)
    parameters = (Parameter("mass", "kg", 1.0),)
    ports = (Port("push", "action", "N"), Port("position", "sensor", "m"))
    time_step = 0.1
    is_deterministic = True

    def begin(self, workspace, parameters, segment, seed):
        if parameters["mass"] < 0.0:
            raise ValueError("negative mass")
        noise = 0.0 if self.is_deterministic else 1e-3 * (seed % 1000)
        return _Cart(parameters["mass"], segment, noise)


def feedback(gains=(-2.0, -1.5)):
    """A spring and a damper."""
    policy = Linear(("position", "velocity"), ("push",))
    return policy.with_parameters(torch.tensor([*gains, 0.0]))


def near_zero(positions, velocities, commands):
    return -positions[0].square() - 0.01 * commands[0].square()


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.slow
def test_episodes_are_those_of_a_loop_written_out():
    out = Cart().roll_out(
        {"mass": doubles(2.0)[0]}, feedback(), doubles(0.5, 1.0), 30, reward=near_zero, record=True
    )
    position, velocity, total = 1.0, 0.5, 0.0
    for k in range(30):
        assert float(out.readings[k, 0]) == pytest.approx(position, abs=1e-12)
        command = -2.0 * position - 1.5 * velocity
        assert float(out.commands[k, 0]) == pytest.approx(command, abs=1e-6)
        total += -(position**2) - 0.01 * command**2
        velocity += 0.1 * min(max(command, -3.0), 3.0) / 2.0
        position += 0.1 * velocity
    assert int(out.lengths) == 30
    assert float(out.returns) == pytest.approx(total, rel=1e-6)


def test_policies_domains_and_states_broadcast():
    policies = feedback().with_parameters(torch.tensor([[-2.0, -1.5, 0.0], [-1.0, 0.0, 0.0]]))
    policies.parameters = policies.parameters[:, None, None]
    masses, states = doubles(1.0, 2.0, 4.0), torch.randn(2, 2).double()
    out = Cart().roll_out({"mass": masses[:, None]}, policies, states, 8, reward=near_zero)
    assert out.returns.shape == (2, 3, 2)
    assert out.readings is None
    one = Cart().roll_out(
        {"mass": masses[2]},
        policies.with_parameters(policies.parameters[1, 0, 0]),
        states[1],
        8,
        reward=near_zero,
    )
    torch.testing.assert_close(out.returns[1, 2, 1], one.returns)


def test_an_episode_ends_where_a_state_leaves_its_bounds_and_records_are_zero_after():
    push = Playback(torch.full((1, 1), 3.0).double(), ("push",), 0.1)
    out = Cart().roll_out({}, push, doubles(4.0, 0.0), 20, reward=near_zero, record=True)
    assert int(out.lengths) == 4  # 4 + 0.3 k > 5
    assert float(out.readings[4, 1]) == pytest.approx(5.2)
    assert bool((out.readings[5:] == 0).all()) and bool((out.commands[4:] == 0).all())
    assert bool((out.commands[:4] == 3).all())


@pytest.mark.slow
def test_playback_is_open_loop(urdf):
    simulator = bullet_pendulum(urdf).with_effects(
        InputDelay("torque"), EncoderBias("angle"), ViscousFriction("hinge")
    )
    parameters = {
        "mass": doubles(0.8, 1.2),
        "torque.input_delay.delay": doubles(0.03)[0],
        "angle.encoder_bias.offset": doubles(0.1)[0],
        "hinge.viscous_friction.damping": doubles(0.2)[0],
    }
    commands = 4.0 * torch.sin(0.3 * torch.arange(40).double())[:, None]
    given = Inputs.single(
        commands, doubles(0.5, 0.0), action_names=("torque",),
        state_names=("angle", "velocity"), time_step=0.02, history=4,
    )  # fmt: skip
    # What is read at a segment's start has the sensor's offset; episodes start from the truth.
    read = replace(given, initial_readings=given.initial_readings + doubles(0.1, 0.0))
    read = replace(read, initial_values=read.initial_readings)
    expected = simulator.simulate(parameters, read)[:, 0]
    out = simulator.roll_out(
        parameters, Playback(commands, ("torque",), 0.02), doubles(0.5, 0.0), 40, record=True
    )
    torch.testing.assert_close(out.readings[:, 1:], expected, rtol=0, atol=1e-12)


def test_bullet_agrees_with_the_equation(urdf):
    policy = Linear(("angle", "velocity"), ("torque",))
    policy = policy.with_parameters(torch.tensor([-3.0, -1.0, 2.0]))
    start = doubles(0.8, -0.5)
    parameters = {"mass": doubles(1.3)[0], "damping": doubles(0.1)[0]}
    bullet = bullet_pendulum(urdf, substeps=10)
    found = bullet.roll_out(parameters, policy, start, 60, record=True)
    ode = Pendulum(integrator="rk4", compile="never")
    expected = ode.roll_out(parameters, policy, start, 60, record=True)
    # Semi-implicit steps of 2 ms: the error is of first order in them.
    assert float((found.readings - expected.readings).abs().max()) < 0.02
    torch.testing.assert_close(found.commands[0], expected.commands[0])


@pytest.mark.slow
def test_random_simulators_follow_the_seed_and_nothing_else():
    class Noisy(Cart):
        is_deterministic = False

    def returns():
        torch.manual_seed(3)
        starts = torch.zeros(6, 2).double()
        return Noisy().roll_out({}, feedback(), starts, 5, reward=near_zero).returns

    first = returns()
    assert len(first.unique()) == 6
    with npdr.workers("threads", num_workers=2, chunk_size=1):
        assert torch.equal(first, returns())


def test_a_lost_episode_is_nan_and_costs_no_other():
    mass = doubles(1.0, -1.0)
    out = Cart().roll_out({"mass": mass}, feedback(), doubles(0.0, 1.0), 5, reward=near_zero)
    assert out.returns.isnan().tolist() == [False, True]
    assert out.lengths.tolist() == [5, 0]


def test_mistakes_are_one_sentence():
    class Blind(Cart):
        sensors = (Cart.states[1],)

    push = Playback(torch.zeros(1, 1).double(), ("push",), 0.1)
    with pytest.raises(ModelError, match="no sensor of velocity"):
        Blind().roll_out({}, push, doubles(0.0, 0.0), 3)
    with pytest.raises(ModelError, match="velocity is on one side only"):
        Blind().roll_out({}, feedback(), doubles(0.0, 0.0), 3)


def test_a_policy_search_improves_on_workers():
    task = ControlTask(
        name="hold",
        policy=feedback((0.0, 0.0)),
        reward=near_zero,
        num_steps=30,
        initial_states=lambda number, stream: torch.tensor([[0.0, 1.0]]).expand(number, 2),
    )
    domains = Domains(Cart(), {"mass": doubles(0.8, 1.2)})
    search = policy_search("power", population=20)
    found = optimise_policy(
        task, domains, search, torch.zeros(3), iterations=4, num_initial_states=1, seed=0
    )
    # Doing nothing earns −1 per step.
    assert found.mean_return > -20.0


def test_path_integral_control_plans_in_any_simulator():
    policy = MPPI(
        Cart(), near_zero, horizon=12, num_samples=24, temperature=0.2, noise=[1.5], num_knots=4,
        replan_every=4,
    )  # fmt: skip
    control = policy.controller({})
    position, velocity = 1.0, 0.0
    for k in range(24):
        (push,) = control([velocity, position], 0.1 * k)
        velocity += 0.1 * push
        position += 0.1 * velocity
    assert abs(position) < 0.4
