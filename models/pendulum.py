"""A pendulum driven by a torque at its hinge."""

import math
from collections.abc import Mapping
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.ode.simulator import Forces, ODESimulator
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.linear_dynamics import BaseParameter, InverseDynamics, Motion
from npdr_ppl.language.noise import Noise
from npdr_ppl.language.sites import simulate

__all__ = ["Pendulum", "PendulumInverseDynamics", "pendulum"]


class PendulumInverseDynamics(InverseDynamics):
    """The equation of :class:`Pendulum`; mass and length follow if g is known."""

    base = (
        BaseParameter("inertia", "kg m²", "m l²/3"),
        BaseParameter("weight", "N m", "m g l/2"),
        BaseParameter("damping", "N m s/rad", "d"),
    )
    determined = ("mass", "length", "damping")
    positive = ("mass", "length", "gravity")
    non_negative = ("damping",)

    def regressors(self, motion: Motion) -> Tensor:
        """Returns Y, ``(N, 1, 3)``."""
        (angle,), (velocity,), (acceleration,) = (
            motion.positions,
            motion.velocities,
            motion.accelerations,
        )
        return torch.stack((acceleration, torch.sin(angle), velocity), dim=-1)[:, None]

    def targets(self, motion: Motion) -> Tensor:
        """Returns the torque, ``(N, 1)``, in N m."""
        return motion.actions[0][:, None]

    def to_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the three combinations."""
        moment = 0.5 * parameters["mass"] * parameters["length"]
        return torch.stack(
            (
                moment * parameters["length"] / 1.5,
                moment * parameters["gravity"],
                parameters["damping"],
            ),
            dim=-1,
        )

    def to_physical(self, base: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns mass, length and damping under the given gravity."""
        inertia, weight, damping = base.unbind(-1)
        moment = weight / given["gravity"]
        length = 1.5 * inertia / moment
        return {"mass": 2.0 * moment / length, "length": length, "damping": damping}


class Pendulum(ODESimulator):
    """A uniform rod on a hinge; angle 0 is hanging.

    m l²/3 · θ̈ = τ − m g (l/2) sin θ − d θ̇, with torque τ, mass m, length l, damping d.

    The hinge's axis is the base's y axis, so the pendulum swings in the x-z plane and a tilt
    about y changes it. A payload is a point mass at the rod's end.
    """

    states = (
        Channel("angle", "rad", -4.0 * math.pi, 4.0 * math.pi),
        Channel("velocity", "rad/s", rate_of="angle"),
    )
    actions = (Channel("torque", "N m", -4.5, 4.5),)
    sensors = states
    parameters = (
        Parameter("mass", "kg", 1.0, "mass of the rod"),
        Parameter("length", "m", 1.0, "length of the rod"),
        Parameter("damping", "N m s/rad", 0.0, "viscous friction of the hinge"),
        Parameter("gravity", "m/s²", 9.81, "acceleration of gravity"),
    )
    joints = ("hinge",)
    ports = (
        Port("torque", "action", "N m", rated=4.5),
        Port("hinge", "force", "N m", rated=4.5, rated_speed=5.0),
        Port("angle", "sensor", "rad", rated=1.0),
        Port("velocity", "sensor", "rad/s", rated=5.0),
        Port("gravity", "environment", "m/s²", rated=9.81),
        Port("payload", "environment", "kg", rated=1.0),
    )
    time_step = 0.02
    default_integrator = "semi-implicit-euler"
    inverse_dynamics = PendulumInverseDynamics()

    def constants(
        self, parameters: Mapping[str, Tensor], environment: Mapping[str, Any]
    ) -> dict[str, Tensor]:
        """Divides the equation by the inertia m l²/3 once."""
        mass, length = parameters["mass"], parameters["length"]
        forward, _, up = environment["gravity"]
        inverse = 3.0 / (mass * length * length)
        lever = 1.5 / length
        payload = environment["payload"]
        if isinstance(payload, Tensor):
            # Factors that are exactly 1 without payload.
            share = payload / mass
            inverse = inverse / (1.0 + 3.0 * share)
            lever = lever * ((1.0 + 2.0 * share) / (1.0 + 3.0 * share))
        constants = {
            "inverse_inertia": inverse,
            "damping": parameters["damping"] * inverse,
            "gravity": up * lever,
        }
        if isinstance(forward, Tensor):
            constants["lateral"] = forward * lever
        return constants

    def accelerations(
        self,
        positions: Components,
        velocities: Components,
        actions: Components,
        forces: Forces,
        constants: dict[str, Tensor],
    ) -> Components:
        """Returns θ̈."""
        (angle,), (velocity,), (torque,), (force,) = positions, velocities, actions, forces
        total = (torque + force) * constants["inverse_inertia"]
        total = total + constants["gravity"] * torch.sin(angle) - constants["damping"] * velocity
        if "lateral" in constants:
            total = total + constants["lateral"] * torch.cos(angle)
        return (total,)

    def inverse_inertia(
        self, positions: Components, velocities: Components, constants: dict[str, Tensor]
    ) -> tuple[Components, ...]:
        """Returns 3/(m l²)."""
        return ((constants["inverse_inertia"],),)


def pendulum(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """A pendulum of unknown mass and length.

    Args:
        inputs: Segments with the channels ``angle``, ``velocity`` and the action ``torque``.
        noise: Measurement noise.
    """
    mass = pyro.sample("mass", dist.Uniform(0.3, 1.7))  # kg
    length = pyro.sample("length", dist.Uniform(0.3, 1.7))  # m
    parameters = {"mass": mass, "length": length}
    return simulate("trajectory", Pendulum(), parameters, inputs, noise=noise)
