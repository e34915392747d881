"""A pendulum with a quasi-direct drive: a rod with the same inertia and weight."""

import pyro
import pyro.distributions as dist
from torch import Tensor

import npdr_ppl as npdr
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.pendulum import Pendulum


def dfki_pendulum(inputs: Inputs) -> Tensor:
    """A pendulum with viscous friction and nothing else."""
    parameters = {
        "mass": pyro.sample("mass", dist.LogNormal(-1.0, 0.7)),  # kg
        "length": pyro.sample("length", dist.LogNormal(-0.2, 0.4)),  # m
        "damping": pyro.sample("damping", dist.HalfNormal(0.1)),  # N m s/rad
    }
    return npdr.simulate("trajectory", Pendulum(integrator="rk4"), parameters, inputs)
