"""Pyro models of the strike: with the paper's ten parameters, and with two restitutions."""

import math

import pyro
import pyro.distributions as dist
from torch import Tensor

from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.noise import Noise
from npdr_ppl.language.sites import simulate
from npdr_ppl.models.mini_golf.simulator import MiniGolf

__all__ = ["mini_golf", "mini_golf_two_restitutions"]


def mini_golf(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """An unknown ball between two obstacles at unknown positions: the paper's ten parameters.

    Args:
        inputs: Whole strikes with the channels ``ball_x`` and ``ball_y`` and the joints' commands.
        noise: Measurement noise.
    """
    restitution = pyro.sample("ball_restitution", dist.Uniform(0.0, 1.0))
    parameters = _ball() | {"ball_restitution": restitution} | _obstacles()
    return simulate("trajectory", MiniGolf(), parameters, inputs, noise=noise)


def mini_golf_two_restitutions(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """As :func:`mini_golf`, with separate rebounds off the club and off obstacles.

    The club's restitution may exceed 1: the recorded head is slower than the ball it launches.

    Args:
        inputs: Whole strikes with the channels ``ball_x`` and ``ball_y`` and the joints' commands.
        noise: Measurement noise.
    """
    parameters = _ball() | {
        "club_restitution": pyro.sample("club_restitution", dist.Uniform(0.0, 2.0)),
        "obstacle_restitution": pyro.sample("obstacle_restitution", dist.Uniform(0.0, 1.0)),
    }
    parameters |= _obstacles()
    everything = parameters | {"ball_restitution": parameters["ball_mass"].new_ones(())}
    return simulate("trajectory", MiniGolf(), everything, inputs, noise=noise)


def _ball() -> dict[str, Tensor]:
    return {
        "ball_radius": pyro.sample("ball_radius", dist.Uniform(0.014, 0.026)),  # m
        "ball_mass": pyro.sample("ball_mass", dist.Uniform(0.0025, 0.0075)),  # kg
        "ball_rolling_friction": pyro.sample(
            "ball_rolling_friction", dist.Uniform(0.0, 5e-4)
        ),  # m
    }


def _obstacles() -> dict[str, Tensor]:
    parameters = {}
    for side in ("left", "right"):
        for axis in ("x", "y"):
            name = f"{side}_shift_{axis}"
            parameters[name] = pyro.sample(name, dist.Uniform(-0.08, 0.08))  # m
        name = f"{side}_turn"
        parameters[name] = pyro.sample(name, dist.Uniform(-math.pi, math.pi))  # rad
    return parameters
