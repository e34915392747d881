"""Gymnasium's MountainCarContinuous as a model: unknown power of the engine."""

import pyro
import pyro.distributions as dist

import npdr_ppl as npdr
from npdr_ppl.engines.gymnasium import Attribute

car = npdr.GymnasiumSimulator(
    "MountainCarContinuous-v0",
    parameters={"power": Attribute("power", "m/s²")},
    states=[
        npdr.Channel("position", "m"),
        npdr.Channel("velocity", "m/s", rate_of="position"),
    ],
    set_state="state",
    actions=[npdr.Channel("throttle", "1")],
    time_step=1.0,
)


def model(inputs):
    power = pyro.sample("power", dist.Uniform(0.0005, 0.0025))  # m/s²
    return npdr.simulate("trajectory", car, {"power": power}, inputs)
