"""Positions that depend on each other, as the heading of a base on its two wheels."""

import numpy as np
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.ode.simulator import ODESimulator
from npdr_ppl.engines.ode.stepping import forces_of
from npdr_ppl.models.effects import LoadDependentFriction


class Base(ODESimulator):
    """Two wheels of inertia one, and the heading that follows from them."""

    states = sensors = (
        npdr.Channel("left", "rad"),
        npdr.Channel("right", "rad"),
        npdr.Channel("heading", "rad"),
        npdr.Channel("left_speed", "rad/s", rate_of="left"),
        npdr.Channel("right_speed", "rad/s", rate_of="right"),
        npdr.Channel("turn", "rad/s", rate_of="heading"),
    )
    actions = (npdr.Channel("left_torque", "N m"), npdr.Channel("right_torque", "N m"))
    joints = ("left_wheel", "right_wheel", "turning")
    parameters = (npdr.Parameter("damping", "N m s/rad", 0.1),)
    ports = tuple(
        npdr.Port(name, "force", "N m") for name in ("left_wheel", "right_wheel", "turning")
    )
    time_step = 0.01

    def accelerations(self, positions, velocities, actions, forces, constants):
        """The heading turns with the difference of the wheels."""
        left = actions[0] + forces[0] - forces[2] - constants["damping"] * velocities[0]
        right = actions[1] + forces[1] + forces[2] - constants["damping"] * velocities[1]
        return left, right, right - left


def test_friction_that_depends_on_load_finds_the_least_forces_of_the_actions():
    friction = LoadDependentFriction("left_wheel")
    base = Base().with_effects(friction)
    rollouts = npdr.Rollouts.from_arrays(
        readings=[np.zeros((21, 6))],
        actions=[np.ones((20, 2))],
        channel_names=[channel.name for channel in Base.states],
        action_names=[channel.name for channel in Base.actions],
        time_step=0.01,
    )
    inputs = rollouts.inputs(None, "recorded")
    parameters = {
        "damping": torch.tensor([0.1]).double(),
        friction.parameter_names[0]: torch.tensor([0.2]).double(),
    }
    found = base.simulate(parameters, inputs)
    assert bool(found.isfinite().all())
    left, right = found[0, 0, -1, 3].item(), found[0, 0, -1, 4].item()
    assert 0.0 < left < right


@pytest.mark.parametrize("size", [2, 3, 4])
def test_forces_are_the_least_where_positions_depend_on_each_other(size):
    generator = torch.Generator().manual_seed(size)
    parts = torch.randn(50, size, size - 1, generator=generator).double()
    inertia = parts @ parts.mT
    inertia[:10] += torch.eye(size).double()
    inertia[10] = torch.nan
    forces = torch.randn(50, size, generator=generator).double()
    caused = (inertia @ forces[..., None])[..., 0]
    rows = tuple(tuple(row.unbind(-1)) for row in inertia.unbind(-2))
    found = torch.stack(forces_of(caused.unbind(-1), rows), dim=-1)
    assert torch.allclose(found[:10], forces[:10])
    assert bool(found[10].isnan().all())
    for matrix, accelerations, force in zip(inertia[11:], caused[11:], found[11:], strict=True):
        least = np.linalg.lstsq(matrix.numpy(), accelerations.numpy(), rcond=1e-9)[0]
        assert np.allclose(force, least, rtol=1e-5, atol=1e-6)


def test_forces_of_two_joints_are_compiled_without_a_branch():
    compiled = torch.compile(forces_of, fullgraph=True, backend="eager")
    accelerations = tuple(torch.tensor([[1.0, 2.0], [3.0, 4.0]]).double())
    inertia = ((torch.tensor([2.0, 1.0]).double(), 0.0), (0.0, torch.tensor([1.0, 0.0]).double()))
    first, second = compiled(accelerations, inertia)
    assert first.tolist() == [0.5, 2.0] and second.tolist() == [3.0, 0.0]
