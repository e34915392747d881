"""Friction at a joint."""

from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import ForceEffect, LinearForceEffect
from npdr_ppl.models.effects.equivalence import DIRECTIONAL_FRICTION, VELOCITY_FEEDBACK
from npdr_ppl.models.effects.references import ARMSTRONG_1994, JANOT_2019, MUJOCO

__all__ = [
    "AsymmetricCoulombFriction",
    "CoulombFriction",
    "QuadraticDrag",
    "StribeckFriction",
    "ViscousFriction",
]


class ViscousFriction(LinearForceEffect):
    """−b v with damping b; not distinguishable from a motor's back-EMF."""

    id = "viscous_friction"
    acts_on_floating = True
    standard_law = "damping"
    parameters = (Parameter("damping", "{port} s/{coordinate}", 0.0, "force per speed b"),)
    law = "−b v"
    equivalence = (VELOCITY_FEEDBACK,)
    excitation = "wide_range"
    reference = ARMSTRONG_1994

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 10 % of the rated force at rated speed."""
        return {"damping": dist.HalfNormal(0.1 * port.rated / port.rated_speed)}

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns −b v."""
        return -parameters["damping"] * velocity

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns −v."""
        return (-velocity,)


class CoulombFriction(LinearForceEffect):
    """−F sign v in motion; at rest the force that keeps the joint at rest, up to F."""

    id = "coulomb_friction"
    parameters = (Parameter("magnitude", "{port}", 0.0, "dry friction F"),)
    standard_law = "dry friction"
    law = "−F sign v; at rest up to F"
    equivalence = (DIRECTIONAL_FRICTION,)
    excitation = "reversals"
    reference = JANOT_2019

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 5 % of the rated force."""
        return {"magnitude": dist.HalfNormal(0.05 * port.rated)}

    def dry_friction(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns F."""
        return parameters["magnitude"]

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns −sign v."""
        return (-velocity.sign(),)


class AsymmetricCoulombFriction(LinearForceEffect):
    """−F₊ in forward and +F₋ in backward motion; not distinguishable from Coulomb plus a bias."""

    id = "asymmetric_coulomb_friction"
    parameters = (
        Parameter("forward", "{port}", 0.0, "dry friction F₊ in forward motion"),
        Parameter("backward", "{port}", 0.0, "dry friction F₋ in backward motion"),
    )
    law = "−F₊ for v > 0, +F₋ for v < 0"
    equivalence = (DIRECTIONAL_FRICTION,)
    excitation = "reversals"
    reference = ARMSTRONG_1994

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 5 % of the rated force each."""
        scale = 0.05 * port.rated
        return {"forward": dist.HalfNormal(scale), "backward": dist.HalfNormal(scale)}

    def dry_friction(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns the bound in the current direction; at rest the smaller one."""
        forward, backward = parameters["forward"], parameters["backward"]
        smaller = torch.minimum(forward, backward)
        moving = torch.where(velocity > 0.0, forward, backward)
        return torch.where(velocity == 0.0, smaller, moving)

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns −1 in forward motion for F₊, and 1 in backward motion for F₋."""
        return -velocity.sign().clamp_min(0.0), -velocity.sign().clamp_max(0.0)


class StribeckFriction(ForceEffect):
    """Additional dry friction near rest: −ΔF exp(−|v/v_s|) sign v.

    Attach it together with Coulomb friction. ΔF is static minus sliding friction.
    """

    id = "stribeck_friction"
    parameters = (
        Parameter("excess", "{port}", 0.0, "static minus sliding friction ΔF"),
        Parameter(
            "speed", "{coordinate}/s", 0.1, "Stribeck velocity v_s in the joint's coordinate"
        ),
    )
    strength = ("excess",)
    contains = ("coulomb_friction",)
    beside = ("coulomb_friction",)
    law = "−ΔF exp(−|v/v_s|) sign v"
    excitation = "slow_ramp"
    reference = ARMSTRONG_1994

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Excess half-normal, 3 % of the rated force; speed log-normal about 0.1 per second."""
        return {
            "excess": dist.HalfNormal(0.03 * port.rated),
            "speed": dist.LogNormal(-2.3, 0.8),
        }

    def dry_friction(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns ΔF exp(−|v/v_s|)."""
        return parameters["excess"] * torch.exp(-velocity.abs() / parameters["speed"])


class QuadraticDrag(LinearForceEffect):
    """−c v|v| with drag c."""

    id = "quadratic_drag"
    acts_on_floating = True
    parameters = (Parameter("drag", "{port} s²/{coordinate}²", 0.0, "force per squared speed c"),)
    law = "−c v|v|"
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 10 % of the rated force at rated speed."""
        return {"drag": dist.HalfNormal(0.1 * port.rated / port.rated_speed**2)}

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns −c v|v|."""
        return -parameters["drag"] * velocity * velocity.abs()

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns −v|v|."""
        return (-velocity * velocity.abs(),)
