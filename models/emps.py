"""EMPS, an electro-mechanical positioning system: a motor, a ball screw and a carriage."""

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

__all__ = ["Emps", "EmpsInverseDynamics", "emps"]


class EmpsInverseDynamics(InverseDynamics):
    """(M/K) q̈ + (F_v/K) q̇ = u: the equation of :class:`Emps` in volts, with the drive's gain K.

    The motion determines M/K and F_v/K only; M and F_v follow if K is known.
    """

    base = (
        BaseParameter("mass_per_gain", "V s²/m", "M/K"),
        BaseParameter("viscous_per_gain", "V s/m", "F_v/K"),
    )
    determined = ("mass", "viscous_friction")
    positive = ("mass", "drive_gain")
    non_negative = ("viscous_friction",)

    def regressors(self, motion: Motion) -> Tensor:
        """Returns Y, ``(N, 1, 2)``."""
        columns = (motion.accelerations[0], motion.velocities[0])
        return torch.stack(columns, dim=-1)[:, None]

    def targets(self, motion: Motion) -> Tensor:
        """Returns the voltage, ``(N, 1)``."""
        return motion.actions[0][:, None]

    def to_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Divides by the gain."""
        columns = (parameters["mass"], parameters["viscous_friction"])
        return torch.stack(columns, dim=-1) / parameters["drive_gain"][..., None]

    def to_physical(self, base: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Multiplies by the gain."""
        mass, viscous = (base * given["drive_gain"][..., None]).unbind(-1)
        return {"mass": mass, "viscous_friction": viscous}

    def force_scale(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns 1/K."""
        return 1.0 / parameters["drive_gain"]


class Emps(ODESimulator):
    """M q̈ = K u − F_v q̇, with position q, motor voltage u and the drive's gain K.

    The real drive also has dry friction and an amplifier offset. These are effects of the
    catalogue: attach ``CoulombFriction("carriage")`` and ``Bias("carriage")``.

    Reference: A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on
    Nonlinear System Identification Benchmarks, 2019. It gives M = 95.1 kg and F_v = 203.5 N s/m,
    the nominal values here, Coulomb friction 20.4 N, and an offset of −3.2 N on the side of the
    inertia, equal to a bias of +3.2 N.
    """

    states = (
        Channel("position", "m", -1.0, 1.0),
        Channel("velocity", "m/s", rate_of="position"),
    )
    actions = (Channel("voltage", "V", -10.0, 10.0),)
    sensors = states
    parameters = (
        Parameter("mass", "kg", 95.1, "carriage with the motor's and screw's inertia M"),
        Parameter("viscous_friction", "N s/m", 203.5, "viscous friction F_v"),
        Parameter("drive_gain", "N/V", 35.15065, "force per voltage K"),
    )
    joints = ("carriage",)
    ports = (
        Port("voltage", "action", "V", rated=5.0),
        Port(
            "carriage",
            "force",
            "N",
            rated=175.0,
            rated_speed=0.1,
            rated_position=0.2,
            coordinate="m",
        ),
        Port("position", "sensor", "m", rated=0.2),
        Port("velocity", "sensor", "m/s", rated=0.1),
        Port("payload", "environment", "kg", rated=95.1),
    )
    time_step = 0.001
    default_integrator = "semi-implicit-euler"
    inverse_dynamics = EmpsInverseDynamics()

    def constants(
        self, parameters: Mapping[str, Tensor], environment: Mapping[str, Any]
    ) -> dict[str, Tensor]:
        """Adds the payload to the mass."""
        return {**parameters, "mass": parameters["mass"] + environment["payload"]}

    def accelerations(
        self,
        positions: Components,
        velocities: Components,
        actions: Components,
        forces: Forces,
        constants: Mapping[str, Tensor],
    ) -> Components:
        """Returns q̈."""
        force = constants["drive_gain"] * actions[0] + forces[0]
        return ((force - constants["viscous_friction"] * velocities[0]) / constants["mass"],)

    def inverse_inertia(
        self, positions: Components, velocities: Components, constants: Mapping[str, Tensor]
    ) -> tuple[Components, ...]:
        """Returns 1/M."""
        return ((1.0 / constants["mass"],),)


def emps(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The positioning system with unknown mass and viscous friction; the drive's gain is known.

    Args:
        inputs: Segments with the action ``voltage``, and measurements of at least ``position``.
        noise: Measurement noise.
    """
    parameters = {
        "mass": pyro.sample("mass", dist.Uniform(50.0, 150.0)),  # kg
        "viscous_friction": pyro.sample("viscous_friction", dist.Uniform(0.0, 500.0)),  # N s/m
    }
    return simulate("trajectory", Emps(), parameters, inputs, noise=noise)
