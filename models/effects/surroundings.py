"""Changes of the environment."""

import math
from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import EnvironmentEffect, LoadEffect
from npdr_ppl.models.effects.equivalence import ANGLE_OFFSET, OVERALL_SCALE
from npdr_ppl.models.effects.references import ATKESON_1986, JANOT_2019, MUJOCO

__all__ = ["Contact", "OffsetPayload", "Payload", "Tilt"]


class Tilt(EnvironmentEffect):
    """A base that is not level: gravity turned about the base's x axis, then about its y axis.

    g' = R_y(pitch) R_x(roll) g.
    """

    id = "tilt"
    parameters = (
        Parameter("roll", "rad", 0.0, "turn of gravity about the base's x axis"),
        Parameter("pitch", "rad", 0.0, "turn of gravity about the base's y axis"),
    )
    law = "R_y(pitch) R_x(roll) g"
    equivalence = (ANGLE_OFFSET,)
    excitation = "slow_ramp"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 2° each."""
        scale = math.radians(2.0)
        return {"roll": dist.Normal(0.0, scale), "pitch": dist.Normal(0.0, scale)}

    def suits(self, port: Port) -> bool:
        """Returns whether the port is gravity."""
        return port.unit == "m/s²"

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


class Payload(EnvironmentEffect):
    """An extra mass Δm at the place of the port, with its inertia and weight.

    In MuJoCo, the place is the centre of mass of the last body; see :class:`OffsetPayload`.
    """

    id = "payload"
    parameters = (Parameter("mass", "{port}", 0.0, "extra mass Δm"),)
    law = "m + Δm"
    equivalence = (OVERALL_SCALE,)
    excitation = "payload"
    reference = JANOT_2019

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 20 % of the port's rated mass."""
        return {"mass": dist.HalfNormal(0.2 * port.rated)}

    def suits(self, port: Port) -> bool:
        """Returns whether the port is a mass."""
        return port.unit == "kg"

    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the port's mass plus Δm."""
        return value + parameters["mass"]


class OffsetPayload(LoadEffect):
    """An extra point mass Δm at (x, y, z) from the place of the port, as of a tool at the tip.

    In MuJoCo, the place is the centre of mass of the last body, and x, y and z are along the
    axes of its frame.
    """

    id = "offset_payload"
    parameters = (
        Parameter("mass", "{port}", 0.0, "extra mass Δm"),
        Parameter("x", "{coordinate}", 0.0, "distance along the body's x axis"),
        Parameter("y", "{coordinate}", 0.0, "distance along the body's y axis"),
        Parameter("z", "{coordinate}", 0.0, "distance along the body's z axis"),
    )
    strength = ("mass",)
    contains = ("payload",)
    law = "m + Δm, with Δm at (x, y, z) from the centre of mass"
    excitation = "payload"
    reference = ATKESON_1986

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Mass half-normal, 20 % of the port's rated mass; each distance 10 % of its length."""
        distance = dist.Normal(0.0, 0.1 * port.rated_position)
        return {"mass": dist.HalfNormal(0.2 * port.rated), "x": distance, "y": distance,
                "z": distance}  # fmt: skip

    def suits(self, port: Port) -> bool:
        """Returns whether the port is the mass of a body that has axes."""
        return port.unit == "kg" and port.coordinate == "m"

    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the port's mass plus Δm."""
        return value + parameters["mass"]

    def place(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Returns (x, y, z)."""
        return parameters["x"], parameters["y"], parameters["z"]


class Contact(EnvironmentEffect):
    """Contact coefficients c exp(ε): friction, restitution, compliance, rolling resistance.

    The port's quantity maps these names to the coefficients that the engine has; coefficients that
    the engine lacks have no effect. A relative change keeps every coefficient positive.
    """

    id = "contact"
    # A foot sticks or slips, so that small changes of friction may change nothing.
    is_smooth = False
    parameters = (
        Parameter("friction", "1", 0.0, "logarithmic change of sliding friction"),
        Parameter("restitution", "1", 0.0, "logarithmic change of restitution"),
        Parameter("compliance", "1", 0.0, "logarithmic change of compliance"),
        Parameter("rolling", "1", 0.0, "logarithmic change of rolling resistance"),
    )
    law = "c exp(ε)"
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 0.5 each, a factor of 1.6."""
        return {parameter.name: dist.Normal(0.0, 0.5) for parameter in self.parameters}

    def suits(self, port: Port) -> bool:
        """Returns whether the port is contact."""
        return port.name.split(".")[-1] == "contact"

    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the changed coefficients by name."""
        return {
            name: coefficient * torch.exp(parameters[name]) if name in parameters else coefficient
            for name, coefficient in value.items()
        }
