"""A pole hinged on a cart that a force pushes along a rail."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

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

__all__ = ["CartPole", "CartPoleInverseDynamics", "cart_pole"]


class CartPoleConstants(NamedTuple):
    """Combinations of the parameters in the equations of motion, see :class:`CartPole`.

    ``lateral`` holds the tilted gravity's terms: its force on cart and pole, and its torque factor
    (m l/2) g_x; ``None`` on a level base.
    """

    total_mass: Tensor
    moment: Tensor
    inertia: Tensor
    gravity: Tensor
    cart_damping: Tensor
    pole_damping: Tensor
    lateral: tuple[Tensor, Tensor] | None


class CartPoleInverseDynamics(InverseDynamics):
    """The equations of :class:`CartPole`; the pole's gravity torque is a separate combination."""

    base = (
        BaseParameter("total_mass", "kg", "M + m"),
        BaseParameter("pole_moment", "kg m", "m l/2"),
        BaseParameter("pole_inertia", "kg m²", "m l²/3"),
        BaseParameter("pole_weight", "N m", "m g l/2"),
        BaseParameter("cart_damping", "N s/m", "c"),
        BaseParameter("pole_damping", "N m s/rad", "d"),
    )
    determined = (
        "cart_mass",
        "pole_mass",
        "pole_length",
        "cart_damping",
        "pole_damping",
        "gravity",
    )
    positive = ("cart_mass", "pole_mass", "pole_length", "gravity")
    non_negative = ("cart_damping", "pole_damping")

    def regressors(self, motion: Motion) -> Tensor:
        """Returns Y, ``(N, 2, 6)``."""
        _, angle = motion.positions
        speed, rate = motion.velocities
        acceleration, angular = motion.accelerations
        sin, cos, zero = torch.sin(angle), torch.cos(angle), torch.zeros_like(angle)
        swing = cos * angular - sin * rate * rate
        cart = torch.stack((acceleration, swing, zero, zero, speed, zero), dim=-1)
        pole = torch.stack((zero, cos * acceleration, angular, sin, zero, rate), dim=-1)
        return torch.stack((cart, pole), dim=-2)

    def targets(self, motion: Motion) -> Tensor:
        """Returns the force on the cart in N and a zero torque in N m, ``(N, 2)``."""
        (force,) = motion.actions
        return torch.stack((force, torch.zeros_like(force)), dim=-1)

    def to_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the six combinations."""
        p = parameters
        moment = 0.5 * p["pole_mass"] * p["pole_length"]
        return torch.stack(
            (
                p["cart_mass"] + p["pole_mass"],
                moment,
                moment * p["pole_length"] / 1.5,
                moment * p["gravity"],
                p["cart_damping"],
                p["pole_damping"],
            ),
            dim=-1,
        )

    def to_physical(self, base: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the six parameters; nothing else is needed."""
        total, moment, inertia, weight, cart_damping, pole_damping = base.unbind(-1)
        length = 1.5 * inertia / moment
        pole_mass = 2.0 * moment / length
        return {
            "cart_mass": total - pole_mass,
            "pole_mass": pole_mass,
            "pole_length": length,
            "cart_damping": cart_damping,
            "pole_damping": pole_damping,
            "gravity": weight / moment,
        }


class CartPole(ODESimulator):
    """A uniform rod on a cart; pole angle 0 is hanging, π upright.

    With cart position x, pole angle θ, force F, cart mass M, pole mass m, pole length l and the
    dampings c and d:

        (M + m) ẍ + (m l/2) (cos θ θ̈ − sin θ θ̇²) = F − c ẋ
        (m l/2) cos θ ẍ + (m l²/3) θ̈ + m g (l/2) sin θ = −d θ̇

    A payload is a point mass at the pole's end. The rail is the base's x axis, and the pole swings
    in the x-z plane.
    """

    states = (
        Channel("cart_position", "m", -3.0, 3.0),
        Channel("pole_angle", "rad", -4.0 * math.pi, 4.0 * math.pi),
        Channel("cart_velocity", "m/s", rate_of="cart_position"),
        Channel("pole_velocity", "rad/s", rate_of="pole_angle"),
    )
    actions = (Channel("force", "N", -20.0, 20.0),)
    sensors = states
    parameters = (
        Parameter("cart_mass", "kg", 1.0, "mass of the cart M"),
        Parameter("pole_mass", "kg", 0.2, "mass of the pole m"),
        Parameter("pole_length", "m", 0.6, "length of the pole l"),
        Parameter("cart_damping", "N s/m", 0.5, "viscous friction of the rail c"),
        Parameter("pole_damping", "N m s/rad", 0.005, "viscous friction of the hinge d"),
        Parameter("gravity", "m/s²", 9.81, "acceleration of gravity g"),
    )
    joints = ("rail", "hinge")
    ports = (
        Port("force", "action", "N", rated=20.0),
        # A moderate push, and the pole's maximum gravity torque.
        Port("rail", "force", "N", rated=10.0, rated_speed=1.0, coordinate="m"),
        Port("hinge", "force", "N m", rated=0.6, rated_speed=5.0, is_driven=False),
        Port("cart_position", "sensor", "m", rated=1.0),
        Port("pole_angle", "sensor", "rad", rated=math.pi),
        Port("cart_velocity", "sensor", "m/s", rated=1.0),
        Port("pole_velocity", "sensor", "rad/s", rated=5.0),
        Port("gravity", "environment", "m/s²", rated=9.81),
        Port("payload", "environment", "kg", rated=0.2),
    )
    time_step = 0.01
    default_integrator = "semi-implicit-euler"
    inverse_dynamics = CartPoleInverseDynamics()

    def constants(
        self, parameters: Mapping[str, Tensor], environment: Mapping[str, Any]
    ) -> CartPoleConstants:
        """Combines the parameters once."""
        p = parameters
        moment = 0.5 * p["pole_mass"] * p["pole_length"]
        total_mass = p["cart_mass"] + p["pole_mass"]
        inertia = moment * p["pole_length"] / 1.5
        payload = environment["payload"]
        if isinstance(payload, Tensor):
            total_mass = total_mass + payload
            moment = moment + payload * p["pole_length"]
            inertia = inertia + payload * p["pole_length"] * p["pole_length"]
        along, _, up = environment["gravity"]
        lateral = (total_mass * along, moment * along) if isinstance(along, Tensor) else None
        return CartPoleConstants(
            total_mass=total_mass,
            moment=moment,
            inertia=inertia,
            gravity=moment * up,
            cart_damping=p["cart_damping"],
            pole_damping=p["pole_damping"],
            lateral=lateral,
        )

    def accelerations(
        self,
        positions: Components,
        velocities: Components,
        actions: Components,
        forces: Forces,
        constants: CartPoleConstants,
    ) -> Components:
        """Returns (ẍ, θ̈), the solution of the two equations."""
        k = constants
        angle, (speed, rate) = positions[1], velocities
        sin, cos = torch.sin(angle), torch.cos(angle)
        push = actions[0] + forces[0] - k.cart_damping * speed + k.moment * sin * rate * rate
        torque = k.gravity * sin - k.pole_damping * rate + forces[1]
        if k.lateral is not None:
            push = push + k.lateral[0]
            torque = torque + k.lateral[1] * cos
        coupling = k.moment * cos
        determinant = k.total_mass * k.inertia - coupling * coupling
        cart = (k.inertia * push - coupling * torque) / determinant
        return cart, (k.total_mass * torque - coupling * push) / determinant

    def inverse_inertia(
        self, positions: Components, velocities: Components, constants: CartPoleConstants
    ) -> tuple[Components, ...]:
        """Returns the inverse of the mass matrix."""
        k = constants
        coupling = k.moment * torch.cos(positions[1])
        scale = 1.0 / (k.total_mass * k.inertia - coupling * coupling)
        cross = -coupling * scale
        return (k.inertia * scale, cross), (cross, k.total_mass * scale)


def cart_pole(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """A cart-pole of unknown masses, pole length and dampings.

    Args:
        inputs: Segments with :class:`CartPole`'s channels.
        noise: Measurement noise.
    """
    parameters = {
        "cart_mass": pyro.sample("cart_mass", dist.Uniform(0.3, 2.0)),  # kg
        "pole_mass": pyro.sample("pole_mass", dist.Uniform(0.05, 0.5)),  # kg
        "pole_length": pyro.sample("pole_length", dist.Uniform(0.2, 1.2)),  # m
        "cart_damping": pyro.sample("cart_damping", dist.Uniform(0.0, 2.0)),  # N s/m
        "pole_damping": pyro.sample("pole_damping", dist.Uniform(0.0, 0.02)),  # N m s/rad
    }
    return simulate("trajectory", CartPole(), parameters, inputs, noise=noise)
