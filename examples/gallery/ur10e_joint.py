"""One joint of a UR10e that lifts the links beyond it: a rod with the same inertia and weight."""

import pyro
import pyro.distributions as dist
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.language.channels import Channel, Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.pendulum import Pendulum


class Joint(Pendulum):
    """The zoo's pendulum without limits of its torque, and with forces of a large arm."""

    actions = (Channel("torque", "N m"),)
    ports = (
        Port("torque", "action", "N m", rated=100.0),
        Port("hinge", "force", "N m", rated=100.0, rated_speed=1.0),
        *Pendulum.ports[2:],
    )


def joint(inputs: Inputs) -> Tensor:
    """A joint with viscous friction and nothing else."""
    parameters = {
        "mass": pyro.sample("mass", dist.LogNormal(2.0, 1.5)),  # kg
        "length": pyro.sample("length", dist.LogNormal(0.5, 0.7)),  # m
        "damping": pyro.sample("damping", dist.HalfNormal(30.0)),  # N m s/rad
    }
    return npdr.simulate("trajectory", Joint(integrator="rk4"), parameters, inputs)
