"""The pole of a Furuta pendulum that swings freely: a rod with the same period."""

import pyro
import pyro.distributions as dist
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.language.channels import Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.pendulum import Pendulum


class Pole(Pendulum):
    """The zoo's pendulum with forces of a pole of 10 g."""

    ports = (
        Port("torque", "action", "N m", rated=0.01),
        Port("hinge", "force", "N m", rated=0.01, rated_speed=15.0),
        *Pendulum.ports[2:],
    )


def pole(inputs: Inputs) -> Tensor:
    """A pole with viscous friction and nothing else. Its mass changes no free swing."""
    parameters = {
        "mass": 0.0098,  # kg, as the authors give it
        "length": pyro.sample("length", dist.LogNormal(-1.8, 0.5)),  # m
        "damping": pyro.sample("damping", dist.HalfNormal(1e-4)),  # N m s/rad
    }
    return npdr.simulate("trajectory", Pole(integrator="rk4"), parameters, inputs)
