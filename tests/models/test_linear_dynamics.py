"""Declared inverse dynamics against the forward dynamics that the simulators integrate."""

import pytest
import torch

from npdr_ppl.engines.ode.simulator import ODESimulator
from npdr_ppl.language.effects import LinearForceEffect
from npdr_ppl.language.linear_dynamics import Motion
from npdr_ppl.models import zoo
from npdr_ppl.models.effects import effects

NUM_STATES = 7
LINEAR = [effect for effect in effects().values() if issubclass(effect, LinearForceEffect)]
SIMULATORS = [
    entry.simulator
    for entry in zoo().values()
    if issubclass(entry.simulator, ODESimulator) and entry.simulator.inverse_dynamics
]


@pytest.fixture(params=SIMULATORS, ids=lambda cls: cls.__name__)
def simulator(request):
    return request.param()


def some(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def some_parameters(simulator):
    """Random positive parameters, one set per state."""
    factor = (0.3 * some(len(simulator.parameters), NUM_STATES, seed=1)).exp()
    return {
        parameter.name: max(parameter.nominal, 1e-5) * factor[i]
        for i, parameter in enumerate(simulator.parameters)
    }


def some_motion(simulator, parameters, forces):
    """Random states and commands, and the accelerations that the simulator gives them."""
    joints = len(simulator.joints)
    positions, velocities = tuple(some(joints, NUM_STATES, seed=2)), tuple(2 * some(joints, 7))
    actions = tuple(some(len(simulator.actions), NUM_STATES, seed=3))
    constants = simulator.constants(parameters, simulator.environment(parameters))
    accelerations = simulator.accelerations(positions, velocities, actions, forces, constants)
    return Motion(positions, velocities, accelerations, actions)


def test_equations_hold_along_the_forward_dynamics(simulator):
    dynamics, parameters = simulator.inverse_dynamics, some_parameters(simulator)
    forces = tuple(some(len(simulator.joints), NUM_STATES, seed=4))
    motion = some_motion(simulator, parameters, forces)
    beta = dynamics.to_base(parameters)
    assert beta.shape == (NUM_STATES, len(dynamics.base))
    left = (dynamics.regressors(motion) * beta[:, None]).sum(-1)
    pushed = dynamics.force_scale(parameters)[:, None] * torch.stack(forces, dim=-1)
    torch.testing.assert_close(left, dynamics.targets(motion) + pushed, rtol=1e-9, atol=1e-9)


def test_physical_parameters_come_back(simulator):
    dynamics, parameters = simulator.inverse_dynamics, some_parameters(simulator)
    found = dynamics.to_physical(dynamics.to_base(parameters), parameters)
    assert set(found) == set(dynamics.determined)
    for name, value in found.items():
        torch.testing.assert_close(value, parameters[name], rtol=1e-9, atol=0.0)
    assert dynamics.is_physical(parameters).all()


def test_what_cannot_exist_is_told(simulator):
    dynamics, parameters = simulator.inverse_dynamics, some_parameters(simulator)
    for name in (*dynamics.positive, *dynamics.non_negative):
        changed = {**parameters, name: -parameters[name]}
        assert not dynamics.is_physical(changed).any()
    lost = {**parameters, dynamics.determined[0]: torch.full((NUM_STATES,), torch.nan)}
    assert not dynamics.is_physical(lost).any()


def test_declared_names_exist(simulator):
    dynamics = simulator.inverse_dynamics
    known = {parameter.name for parameter in simulator.parameters}
    assert {*dynamics.determined, *dynamics.positive, *dynamics.non_negative} <= known
    assert len({parameter.name for parameter in dynamics.base}) == len(dynamics.base)
    assert all(parameter.unit for parameter in dynamics.base)
    ports = tuple(port.name for port in simulator.ports if port.kind == "force")
    assert ports == simulator.joints, "rows and force ports share one order"


@pytest.mark.parametrize("cls", LINEAR, ids=lambda cls: cls.id)
def test_linear_effects_are_sums_of_columns(cls):
    effect = cls("joint")
    drawn = some(len(effect.parameters), NUM_STATES, seed=5).abs()
    parameters = {p.name: drawn[i] for i, p in enumerate(effect.parameters)}
    position, velocity = some(2, NUM_STATES, seed=6)
    base = effect.to_base(parameters)
    columns = effect.columns(position, velocity)
    total = sum(column * value for column, value in zip(columns, base, strict=True))
    force = effect.force(position, velocity, parameters, None)
    dry = effect.dry_friction(position, velocity, parameters, None)
    expected = (0.0 if force is None else force) - (0.0 if dry is None else dry * velocity.sign())
    torch.testing.assert_close(total, expected)
    back = effect.from_base(base)
    assert set(back) == set(parameters)
    for name, value in back.items():
        torch.testing.assert_close(value, parameters[name])
