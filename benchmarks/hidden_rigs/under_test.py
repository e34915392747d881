"""The models under test: the zoo's, with what a rig's owner would not know left to infer.

They use Runge–Kutta steps: at the zoo's default of one Euler step per sample, the error of the
integrator alone would be a discovery.
"""

from functools import cache

import pyro
import pyro.distributions as dist
from torch import Tensor

from hidden_rigs.hidden import Hidden
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.noise import Noise
from npdr_ppl.language.sites import simulate
from npdr_ppl.models.cart_pole import CartPole
from npdr_ppl.models.emps import Emps
from npdr_ppl.models.furuta import Furuta
from npdr_ppl.models.pendulum import Pendulum
from npdr_ppl.models.two_link_arm import TwoLinkArm

__all__ = [
    "as_hidden",
    "cart_pole",
    "cart_pole_simulator",
    "emps",
    "emps_simulator",
    "furuta",
    "furuta_simulator",
    "pendulum",
    "pendulum_simulator",
    "two_link_arm",
    "two_link_arm_simulator",
]


def as_hidden(effect: Effect, hidden: Hidden) -> Effect:
    """Returns an effect of the catalogue with the number of ripples per turn that is hidden."""
    return effect.with_ripples(int(hidden.parameters["order"])) if effect.has_ripples else effect


@cache
def pendulum_simulator() -> Pendulum:
    return Pendulum(integrator="rk4")


@cache
def cart_pole_simulator() -> CartPole:
    return CartPole(integrator="rk4")


@cache
def emps_simulator() -> Emps:
    return Emps(integrator="rk4")


@cache
def furuta_simulator() -> Furuta:
    return Furuta(integrator="rk4")


@cache
def two_link_arm_simulator() -> TwoLinkArm:
    return TwoLinkArm()


def pendulum(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """A pendulum of unknown mass and length, without friction.

    Args:
        inputs: Segments.
        noise: Noise of the readings.
    """
    parameters = {
        "mass": pyro.sample("mass", dist.Uniform(0.3, 1.7)),  # kg
        "length": pyro.sample("length", dist.Uniform(0.3, 1.7)),  # m
    }
    return simulate("trajectory", pendulum_simulator(), parameters, inputs, noise=noise)


def cart_pole(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """A cart-pole of unknown masses, pole length and dampings.

    Args:
        inputs: Segments.
        noise: Noise of the readings.
    """
    parameters = {
        "cart_mass": pyro.sample("cart_mass", dist.Uniform(0.3, 2.0)),  # kg
        "pole_mass": pyro.sample("pole_mass", dist.Uniform(0.05, 0.5)),  # kg
        "pole_length": pyro.sample("pole_length", dist.Uniform(0.2, 1.2)),  # m
        "cart_damping": pyro.sample("cart_damping", dist.Uniform(0.0, 2.0)),  # N s/m
        "pole_damping": pyro.sample("pole_damping", dist.Uniform(0.0, 0.02)),  # N m s/rad
    }
    return simulate("trajectory", cart_pole_simulator(), parameters, inputs, noise=noise)


def emps(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The EMPS drive of unknown mass and viscous friction.

    Args:
        inputs: Segments.
        noise: Noise of the readings.
    """
    parameters = {
        "mass": pyro.sample("mass", dist.Uniform(50.0, 150.0)),  # kg
        "viscous_friction": pyro.sample("viscous_friction", dist.Uniform(0.0, 500.0)),  # N s/m
    }
    return simulate("trajectory", emps_simulator(), parameters, inputs, noise=noise)


def furuta(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The zoo's Furuta pendulum with gravity known.

    Args:
        inputs: Segments.
        noise: Noise of the readings.
    """
    parameters = {
        name: pyro.sample(name, dist.Uniform(low, high))
        for name, (low, high) in _FURUTA_PRIOR.items()
    }
    return simulate("trajectory", furuta_simulator(), parameters, inputs, noise=noise)


def two_link_arm(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The arm with unknown upper mass and dampings; the lower link has been weighed.

    Args:
        inputs: Segments.
        noise: Noise of the readings.
    """
    parameters = {
        "upper_mass": pyro.sample("upper_mass", dist.Uniform(0.6, 1.8)),  # kg
        "shoulder_damping": pyro.sample("shoulder_damping", dist.Uniform(0.0, 0.4)),  # N m s/rad
        "elbow_damping": pyro.sample("elbow_damping", dist.Uniform(0.0, 0.15)),  # N m s/rad
    }
    return simulate("trajectory", two_link_arm_simulator(), parameters, inputs, noise=noise)


_FURUTA_PRIOR = {
    "motor_resistance": (0.84, 15.96),  # Ω
    "motor_constant": (0.0084, 0.0756),  # V s/rad
    "arm_mass": (0.0285, 0.1615),  # kg
    "arm_length": (0.0425, 0.1275),  # m
    "pole_mass": (0.0072, 0.0408),  # kg
    "pole_length": (0.0645, 0.1935),  # m
    "arm_damping": (0.0, 1e-3),  # N m s/rad
    "pole_damping": (0.0, 1e-4),  # N m s/rad
}
