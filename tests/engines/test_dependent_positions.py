"""Positions that depend on each other, as the heading of a base on its two wheels."""

import numpy as np
import torch

import npdr_ppl as npdr
from npdr_ppl.engines.ode.simulator import ODESimulator
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
