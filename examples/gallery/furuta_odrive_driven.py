"""A Furuta pendulum with an ODrive motor, driven by a voltage."""

import pyro
import pyro.distributions as dist
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.language.channels import Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.furuta import Furuta


class SmallFuruta(Furuta):
    """The zoo's Furuta pendulum with forces of this rig."""

    ports = (
        Port("voltage", "action", "V", rated=2.0),
        Port("arm", "force", "N m", rated=0.01, rated_speed=5.0),
        Port("pole", "force", "N m", rated=0.01, rated_speed=10.0, is_driven=False),
        *Furuta.ports[3:],
    )


def furuta(inputs: Inputs) -> Tensor:
    """Motor, arm and pole with viscous friction and nothing else.

    The motor's constants are free: with those of the authors, the arm would move at a seventh of
    the recorded speed. The arm's mass is that of a rod with the moment of inertia of the arm and
    the motor.
    """
    parameters = {
        "pole_mass": 0.01125,  # kg, of a rod with the authors' moment and moment of inertia
        "arm_length": 0.0935,  # m
        "motor_constant": pyro.sample("motor_constant", dist.LogNormal(-2.3, 0.7)),  # N m/A
        "motor_resistance": pyro.sample("motor_resistance", dist.LogNormal(2.8, 0.7)),  # Ω
        "arm_mass": pyro.sample("arm_mass", dist.LogNormal(0.0, 0.7)),  # kg
        "pole_length": pyro.sample("pole_length", dist.LogNormal(-1.8, 0.3)),  # m
        "arm_damping": pyro.sample("arm_damping", dist.HalfNormal(0.01)),  # N m s/rad
        "pole_damping": pyro.sample("pole_damping", dist.HalfNormal(1e-4)),  # N m s/rad
    }
    return npdr.simulate("trajectory", SmallFuruta(integrator="rk4"), parameters, inputs)
