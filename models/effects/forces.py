"""Forces at a joint that are not friction."""

from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import LinearForceEffect
from npdr_ppl.models.effects.equivalence import (
    ANGLE_OFFSET,
    DIRECTIONAL_FRICTION,
    POSITION_SCALE,
)
from npdr_ppl.models.effects.references import BITTENCOURT_2012, JANOT_2019, MUJOCO

__all__ = ["Bias", "HardeningSpring", "Spring", "Unbalance"]


class Bias(LinearForceEffect):
    """A constant force c."""

    id = "bias"
    parameters = (Parameter("offset", "{port}", 0.0, "constant force c"),)
    law = "c"
    equivalence = (DIRECTIONAL_FRICTION,)
    excitation = "reversals"
    reference = JANOT_2019

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 2 % of the rated force."""
        return {"offset": dist.Normal(0.0, 0.02 * port.rated)}

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns c."""
        return parameters["offset"]

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns 1."""
        return (torch.ones_like(position),)


class Spring(LinearForceEffect):
    """−k (q − q₀): a spring, or a cable that moves with the joint."""

    id = "spring"
    standard_law = "spring"
    parameters = (
        Parameter("stiffness", "{port}/{coordinate}", 0.0, "stiffness k"),
        Parameter("rest", "{coordinate}", 0.0, "position q₀ without force"),
    )
    strength = ("stiffness",)
    beside = ("bias",)
    law = "−k (q − q₀)"
    equivalence = (POSITION_SCALE,)
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Stiffness half-normal, 5 % of rated at rated position; rest normal, half of that."""
        return {
            "stiffness": dist.HalfNormal(0.05 * port.rated / port.rated_position),
            "rest": dist.Normal(0.0, 0.5 * port.rated_position),
        }

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns −k (q − q₀)."""
        return -parameters["stiffness"] * (position - parameters["rest"])

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns −q for k, and 1 for k q₀."""
        return -position, torch.ones_like(position)

    def to_base(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Returns k and k q₀."""
        return parameters["stiffness"], parameters["stiffness"] * parameters["rest"]

    def from_base(self, base: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """Returns k and q₀."""
        stiffness, preload = base
        return {"stiffness": stiffness, "rest": preload / stiffness}


class HardeningSpring(LinearForceEffect):
    """−k₃ q³."""

    id = "hardening_spring"
    parameters = (Parameter("stiffness", "{port}/{coordinate}³", 0.0, "cubic stiffness k₃"),)
    law = "−k₃ q³"
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 5 % of the rated force at the rated position."""
        return {"stiffness": dist.HalfNormal(0.05 * port.rated / port.rated_position**3)}

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns −k₃ q³."""
        return -parameters["stiffness"] * position * position * position

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns −q³."""
        return (-position * position * position,)


class Unbalance(LinearForceEffect):
    """a sin q + b cos q: an eccentric mass m r under gravity, a = m r g cos φ, b = m r g sin φ."""

    id = "unbalance"
    parameters = (
        Parameter("sine", "{port}", 0.0, "force a at q = 90°"),
        Parameter("cosine", "{port}", 0.0, "force b at q = 0"),
    )
    law = "a sin q + b cos q"
    equivalence = (ANGLE_OFFSET,)
    excitation = "slow_ramp"
    reference = BITTENCOURT_2012

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 3 % of the rated force each."""
        scale = 0.03 * port.rated
        return {"sine": dist.Normal(0.0, scale), "cosine": dist.Normal(0.0, scale)}

    def suits(self, port: Port) -> bool:
        """Returns whether the joint turns."""
        return port.coordinate == "rad"

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns a sin q + b cos q."""
        sine = parameters["sine"] * torch.sin(position)
        return sine + parameters["cosine"] * torch.cos(position)

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns sin q and cos q."""
        return torch.sin(position), torch.cos(position)
