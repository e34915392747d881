"""What every policy promises, and the known answers of each."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.linalg import solve_continuous_are

from npdr_ppl.engines.common import compilation
from npdr_ppl.engines.common.compilation import has_compiler
from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.policies.linear import AngleFeatures, Linear
from npdr_ppl.policies.neural import Neural
from npdr_ppl.policies.playback import Chirp, Playback, Sinusoid, Strike
from npdr_ppl.policies.radial_basis import RadialBasis

STATES = tuple(state.name for state in CartPole.states)
ANGLES = AngleFeatures(STATES, ("pole_angle",))
LIMITS = ((-20.0, 20.0),)
POLICIES = {
    "playback": Playback(torch.linspace(-8.0, 8.0, 15)[:, None], ("force",), 0.01),
    "sinusoid": Sinusoid("force"),
    "chirp": Chirp("force"),
    "strike": Strike(("force",), [1.0], [-2.0], duration=0.2, limits=[(-5.0, 5.0)]),
    "linear": Linear(STATES, ("force",), max_gain=20.0),
    "linear, angle features": Linear(STATES, ("force",), features=ANGLES, max_gain=20.0),
    "radial basis, grid": RadialBasis.on_grid(
        ("pole_angle", "pole_velocity"), ("force",), [(-3.0, 3.0), (-5.0, 5.0)], (4, 3), LIMITS
    ),
    "radial basis, random": RadialBasis.at_random(
        ("cart_position", "pole_angle"), ("force",), [(-1.0, 1.0), (-3.0, 3.0)], 5, LIMITS
    ),
    "neural": Neural(STATES, ("force",), LIMITS, hidden=(3, 2), features=ANGLES),
    "neural, no hidden layer": Neural(STATES, ("force",), LIMITS, hidden=()),
}
every_policy = pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def some_policies(policy, num_policies, dtype):
    """A batch of one's kind on an axis of its own, (policies, 1, 1)."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(num_policies, 1, 1, len(policy.names), generator=generator)
    return policy.with_parameters((policy.parameters + 0.3 * noise).to(dtype))


def some_domains(num_domains, dtype):
    return {"pole_mass": torch.linspace(0.1, 0.4, num_domains, dtype=dtype)[:, None]}


def some_states(num_states, dtype):
    generator = torch.Generator().manual_seed(1)
    return torch.randn(num_states, 4, generator=generator).to(dtype)


def reward(positions, velocities, commands):
    return -positions[1].square() - 0.01 * commands[0].square()


@every_policy
def test_parameters_are_named_and_bounded(policy):
    lower, upper = policy.bounds
    assert len(set(policy.names)) == len(policy.names) == policy.parameters.shape[-1]
    assert ((lower <= policy.parameters) & (policy.parameters <= upper)).all()
    moved = policy.with_parameters(policy.parameters + 1.0)
    assert type(moved) is type(policy) and moved.names == policy.names
    assert torch.equal(moved.parameters, policy.parameters + 1.0)
    with pytest.raises(ShapeError, match="parameters"):
        policy.with_parameters(torch.zeros(len(policy.names) + 1))


@every_policy
@both_dtypes
def test_batch_equals_a_loop(policy, dtype):
    policies, domains = some_policies(policy, 2, dtype), some_domains(3, dtype)
    states = some_states(2, dtype)
    out = CartPole().roll_out(domains, policies, states, 20, reward=reward, record=True)
    again = CartPole().roll_out(domains, policies, states, 20, reward=reward)
    assert out.returns is not None and out.commands is not None
    assert out.commands.shape == (2, 3, 2, 20, 1)
    assert out.commands.dtype == dtype or not policy.names  # recordings keep their own
    assert torch.equal(again.returns, out.returns)
    for i, j, k in [(0, 0, 0), (1, 2, 1), (0, 1, 1)]:
        one = CartPole().roll_out(
            {"pole_mass": domains["pole_mass"][j, 0]},
            policies.with_parameters(policies.parameters[i, 0, 0]),
            states[k],
            20,
            reward=reward,
            record=True,
        )
        torch.testing.assert_close(out.returns[i, j, k], one.returns)
        torch.testing.assert_close(out.commands[i, j, k], one.commands)


@every_policy
def test_a_device_gets_the_same_commands(policy):
    one = policy.with_parameters(some_policies(policy, 1, torch.float64).parameters[0, 0, 0])
    start = some_states(1, torch.float64)[0]
    out = CartPole().roll_out({}, one, start, 10, record=True)
    control = one.controller({})
    columns = [STATES.index(name) for name in policy.observations]
    for step in range(10):
        commands = control(out.readings[step, columns].numpy(), 0.01 * step)
        assert isinstance(commands, np.ndarray) and commands.shape == (1,)
        np.testing.assert_allclose(commands, out.commands[step], rtol=1e-10, atol=1e-12)


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler("cpu"), reason="there is no C++ compiler")
@pytest.mark.parametrize("kind", ["playback", "radial basis, random", "neural"])
def test_compiled_loop_agrees_with_the_eager_one(kind, request, monkeypatch):
    if kind != "playback":  # which compiles fast, and is tested at full length
        request.getfixturevalue("short_kernels")
        monkeypatch.setattr(compilation, "_STEPS_PER_CALL", (1,))  # a second one doubles the time
    policies = some_policies(POLICIES[kind], 3, torch.float64)
    domains, states = some_domains(2, torch.float64), some_states(2, torch.float64)
    eager, fast = (
        CartPole().roll_out(domains, policies, states, 23, reward=reward, compile=mode)
        for mode in ("never", "always")
    )
    torch.testing.assert_close(fast.returns, eager.returns)


def act(policy, observation=(), time=0.0):
    observation = tuple(torch.as_tensor(x, dtype=torch.float64) for x in observation)
    policy = policy.with_parameters(policy.parameters.double())
    commands, _ = policy.act(observation, time, None, policy.constants({}))
    return torch.stack(commands)


@pytest.mark.parametrize("profile", ["linear", "minimum-jerk"])
def test_strike_goes_from_start_to_end(profile):
    start, end = [0.3, -1.5, 1.3], [0.1, -1.6, 1.4]
    strike = Strike(("j1", "j2", "j3"), start, end, duration=0.5, profile=profile)
    assert strike.names == ("duration", "j1.end", "j2.end", "j3.end")
    start, end = (torch.tensor(x).double() for x in (start, end))
    path = torch.stack([act(strike, time=0.5 * k / 200) for k in range(201)])
    torch.testing.assert_close(path[0], start)
    torch.testing.assert_close(path[100], 0.5 * (start + end))
    torch.testing.assert_close(path[200], end)
    torch.testing.assert_close(act(strike, time=9.0), end)
    speed = path.diff(dim=0).abs() * 200  # per duration
    peak, ends = (1.875, 0.0) if profile == "minimum-jerk" else (1.0, 1.0)
    way = (end - start).abs()
    torch.testing.assert_close(speed.amax(0), peak * way, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(speed[[0, -1]], (ends * way).expand(2, 3), atol=1e-3, rtol=1e-6)


def test_strike_and_chirp_survive_a_duration_of_zero():
    assert torch.isfinite(act(Strike(("q",), [0.0], [1.0], duration=0.0))).all()
    assert torch.isfinite(act(Chirp("u", torch.tensor([1.0, 1.0, 2.0, 0.0, 0.0])))).all()


def test_playback_holds_its_last_commands():
    commands = torch.arange(6.0).reshape(3, 2)
    playback = Playback(commands, ("a", "b"), 0.1)
    for step, row in [(0, 0), (1, 1), (2, 2), (7, 2)]:
        np.testing.assert_array_equal(
            playback.controller({})(np.zeros(0), 0.1 * step), commands[row]
        )


def test_linear_is_the_matrix_product():
    generator = torch.Generator().manual_seed(3)
    table = torch.randn(2, 4, generator=generator, dtype=torch.float64)
    policy = Linear(("x", "y", "z"), ("a", "b"), parameters=table.flatten())
    assert policy.names == ("a.x", "a.y", "a.z", "a.bias", "b.x", "b.y", "b.z", "b.bias")
    o = torch.randn(3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(act(policy, o), table[:, :3] @ o + table[:, 3])


def test_angle_features_do_not_count_turns():
    policy = POLICIES["linear, angle features"]
    assert "force.sin_pole_angle" in policy.names
    policy = policy.with_parameters(torch.linspace(-1.0, 1.0, len(policy.names)).double())
    state = [0.1, 0.7, 0.2, 0.3]
    turned = [0.1, 0.7 + 4.0 * math.pi, 0.2, 0.3]
    torch.testing.assert_close(act(policy, state), act(policy, turned))


def test_linear_balances_the_pole():
    """Its gains are those of the linear-quadratic regulator of the linearised cart-pole."""
    simulator = CartPole()
    nominal = simulator.nominal()
    constants = simulator.constants(nominal, simulator.environment(nominal))

    def rates(state, force):
        positions, velocities = state.unbind()[:2], state.unbind()[2:]
        return torch.stack(
            velocities
            + simulator.accelerations(positions, velocities, (force[0],), (0.0, 0.0), constants)
        )

    upright = torch.tensor([0.0, math.pi, 0.0, 0.0], dtype=torch.float64)
    a, b = torch.autograd.functional.jacobian(rates, (upright, torch.zeros(1).double()))
    costs = np.diag([1.0, 10.0, 0.1, 0.1]), np.eye(1)
    gains = -torch.tensor(b.numpy().T @ solve_continuous_are(a.numpy(), b.numpy(), *costs))[0]
    policy = Linear(
        STATES, ("force",), parameters=torch.cat((gains, -(gains @ upright).reshape(1)))
    )
    start = upright + torch.tensor([0.2, 0.15, 0.0, 0.0])
    out = simulator.roll_out({}, policy, start, 1000, record=True)
    assert (out.readings[-1] - upright).abs().max() < 0.01


def test_radial_basis_is_the_normalised_sum():
    policy = POLICIES["radial basis, grid"]
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(12, generator=generator, dtype=torch.float64)
    policy = policy.with_parameters(values)
    centres = torch.tensor(policy.centres, dtype=torch.float64)
    assert centres[:, 0].unique().tolist() == [-3.0, -1.0, 1.0, 3.0]
    assert policy.widths == (2.0, 5.0)
    o = torch.tensor([0.4, 2.0], dtype=torch.float64)
    g = torch.exp(-0.5 * ((o - centres) / torch.tensor(policy.widths)).square().sum(-1))
    torch.testing.assert_close(act(policy, o), (values * g).sum()[None] / g.sum())
    # Far away, where every g underflows, the nearest centre decides.
    torch.testing.assert_close(act(policy, [900.0, 900.0]), values[-1:])


def test_random_centres_follow_the_seed():
    def centres(seed):
        ranges = [(-1.0, 1.0), (2.0, 3.0)]
        return RadialBasis.at_random(("x", "y"), ("u",), ranges, 6, LIMITS, seed=seed).centres

    assert centres(1) == centres(1) != centres(2)
    assert all(-1.0 <= x <= 1.0 and 2.0 <= y <= 3.0 for x, y in centres(1))


def test_neural_equals_a_torch_network():
    sizes, limits = (3, 5, 4, 2), [(-1.0, 3.0), (0.0, 10.0)]
    scales = [1.0, 2.0, 4.0]
    policy = Neural(("x", "y", "z"), ("a", "b"), limits, hidden=(5, 4), scales=scales, seed=2)
    layers, place = [], 0
    for inputs, outputs in itertools.pairwise(sizes):
        size = outputs * (inputs + 1)
        table = policy.parameters[place : place + size].double().reshape(outputs, inputs + 1)
        place += size
        linear = torch.nn.Linear(inputs, outputs, dtype=torch.float64)
        linear.load_state_dict({"weight": table[:, :-1], "bias": table[:, -1]})
        layers += [linear, torch.nn.Tanh()]
    assert place == len(policy.names)
    o = torch.tensor([0.3, -1.0, 5.0], dtype=torch.float64)
    with torch.no_grad():
        squashed = torch.nn.Sequential(*layers)(o / torch.tensor(scales))
    expected = torch.tensor([1.0, 5.0]) + torch.tensor([2.0, 5.0]) * squashed
    torch.testing.assert_close(act(policy, o), expected)


def test_neural_defaults_follow_the_seed():
    def defaults(seed):
        return Neural(STATES, ("force",), LIMITS, seed=seed).parameters

    assert torch.equal(defaults(1), defaults(1))
    assert not torch.equal(defaults(1), defaults(2))


class WrongFeatures:
    names = ("one", "two")

    def __call__(self, observation):
        return observation


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Playback(torch.zeros(3, 2), ("a",), 0.1), "recorded sequence"),
        (lambda: Strike(("a", "b"), [0.0], [0.0, 1.0]), "1 starts, 2 ends"),
        (lambda: Strike(("a",), [0.0], [0.0], profile="cubic"), "cubic"),
        (lambda: Linear(("x",), ("u",), features=WrongFeatures()), "2 names, but 1 values"),
        (lambda: AngleFeatures(("x",), ("phi",)), "angle phi"),
        (lambda: Neural(("x",), ("u",), []), "0 limits"),
        (lambda: Neural(("x",), ("u",), LIMITS, scales=[1.0, 2.0]), "2 scales"),
        (lambda: RadialBasis(("x",), ("u",), torch.zeros(3, 2), [1.0], LIMITS), "Centres"),
        (lambda: RadialBasis(("x",), ("u",), torch.zeros(3, 1), [0.0], LIMITS), "positive"),
        (lambda: RadialBasis.on_grid(("x",), ("u",), [(0.0, 1.0)], (1,), LIMITS), "at least 2"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises((ModelError, ShapeError), match=message):
        make()
