"""Texts of Python files that define effects, as a user or a search for laws may write them."""

CUBIC = '''"""A law that was learnt from a recording."""

from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import ForceEffect

POWER = 3
"""Power of the speed."""


def hat(value: Tensor) -> Tensor:
    """Returns the power of a value."""
    return value**POWER


class LearnedHinge(ForceEffect):
    """−c v³: damping that grows with the cube of the speed."""

    id = "learned_hinge"
    parameters = (Parameter("cubic", "{port} s³/{coordinate}³", 0.0, "force per cubed speed c"),)
    law = "−c v³"

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 10 % of the rated force at rated speed."""
        return {"cubic": dist.HalfNormal(0.1 * port.rated / port.rated_speed**3)}

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns −c v³."""
        return -parameters["cubic"] * hat(velocity)
'''

GAIN = '''"""An action and a sensor that are off, in one file."""

import pyro.distributions as dist

from npdr_ppl import Parameter
from npdr_ppl.language.effects import ActionEffect, SensorEffect


def hat(value, size):
    return value + size


class Pushed(ActionEffect):
    """u + u₀."""

    id = "pushed"
    parameters = (Parameter("push", "{port}", 0.0, "offset u₀"),)

    def default_priors(self, port):
        return {"push": dist.Normal(0.0, 0.1 * port.rated)}

    def act(self, commands, parameters, memory, time_step):
        return hat(commands.now(), parameters["push"]), memory


class Shifted(SensorEffect):
    """y + y₀."""

    id = "shifted"
    parameters = (Parameter("shift", "{port}", 0.0, "offset y₀"),)

    def default_priors(self, port):
        return {"shift": dist.Normal(0.0, 0.1 * port.rated)}

    def read(self, value, parameters, memory, time_step):
        return hat(value, parameters["shift"]), memory
'''

DAMPING = '''"""An effect of a user's own."""

import pyro.distributions as dist

from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.effects import ForceEffect


class CubicDamping(ForceEffect):
    """−c v³."""

    id = "cubic_damping"
    parameters = (Parameter("damping", "N m s³/rad³", 0.0),)

    def default_priors(self, port):
        return {"damping": dist.Normal(0.0, 1.0)}

    def force(self, position, velocity, parameters, memory):
        return -parameters["damping"] * velocity**3
'''
