"""Gymnasium's Pendulum as a model: unknown mass and length."""

import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from npdr_ppl.engines.gymnasium import Attribute

pendulum = npdr.GymnasiumSimulator(
    "Pendulum-v1",
    parameters={"mass": Attribute("m", "kg"), "length": Attribute("l", "m")},
    states=[
        npdr.Channel("angle", "rad"),
        npdr.Channel("velocity", "rad/s", rate_of="angle"),
    ],
    set_state="state",
    actions=[npdr.Channel("torque", "N m")],
)


def model(inputs):
    mass = pyro.sample("mass", dist.Uniform(0.5, 1.5))  # kg
    length = pyro.sample("length", dist.Uniform(0.5, 1.5))  # m
    return npdr.simulate("trajectory", pendulum, {"mass": mass, "length": length}, inputs)
