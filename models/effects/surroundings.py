"""Changes of the environment."""

import math
from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import EnvironmentEffect

__all__ = ["Tilt"]


class Tilt(EnvironmentEffect):
    """A base that is not level: gravity turned about the base's x axis, then about its y axis.

    g' = R_y(pitch) R_x(roll) g.
    """

    id = "tilt"
    parameters = (
        Parameter("roll", "rad", 0.0, "turn of gravity about the base's x axis"),
        Parameter("pitch", "rad", 0.0, "turn of gravity about the base's y axis"),
    )

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 2° each."""
        scale = math.radians(2.0)
        return {"roll": dist.Normal(0.0, scale), "pitch": dist.Normal(0.0, scale)}

    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the turned vector.

        Args:
            value: Gravity (x, y, z) in m/s²: three components, or a tensor ``(..., 3)``.
            parameters: Roll and pitch, in rad.
        """
        is_tensor = isinstance(value, Tensor)
        x, y, z = value.unbind(-1) if is_tensor else value
        sin, cos = torch.sin(parameters["roll"]), torch.cos(parameters["roll"])
        y, z = cos * y - sin * z, sin * y + cos * z
        sin, cos = torch.sin(parameters["pitch"]), torch.cos(parameters["pitch"])
        x, z = cos * x + sin * z, cos * z - sin * x
        return torch.stack(torch.broadcast_tensors(x, y, z), dim=-1) if is_tensor else (x, y, z)
