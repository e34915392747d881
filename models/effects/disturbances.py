"""External forces and changes: ripple, wind, vibration, drift."""

import copy
import math
from collections.abc import Mapping
from typing import Any, Self

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effects import ForceEffect, LinearForceEffect, ParameterEffect
from npdr_ppl.models.effects.references import (
    ARMSTRONG_1994,
    BITTENCOURT_2012,
    LJUNG_1999,
    MUJOCO,
)
from npdr_ppl.models.effects.timed import TimedForceEffect

__all__ = ["Cogging", "ParameterDrift", "PeriodicDisturbance", "Wind"]


class Cogging(LinearForceEffect):
    """a sin N q + b cos N q: torque ripple with N periods per turn.

    Args:
        port: Name of the port to attach to.
        order: Number of periods per turn N, if it is known from the motor's poles and slots and
            its gear. Otherwise a search takes the best whole number, and N is 12 without a search.
        priors: Priors that replace the effect's own, by parameter name.
    """

    id = "cogging"
    parameters = (
        Parameter("sine", "{port}", 0.0, "amplitude a of the sine"),
        Parameter("cosine", "{port}", 0.0, "amplitude b of the cosine"),
    )
    law = "a sin N q + b cos N q"
    excitation = "constant_speed"
    reference = ARMSTRONG_1994

    def __init__(
        self,
        port: str,
        *,
        order: float | None = None,
        priors: Mapping[str, Distribution] | None = None,
    ) -> None:
        super().__init__(port, priors=priors)
        self.has_ripples = order is None
        order = 12 if order is None else order
        if order < 1:
            raise ModelError(f"cogging has at least one period per turn, got {order=}.")
        self.order = order

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 2 % of the rated force each."""
        scale = 0.02 * port.rated
        return {"sine": dist.Normal(0.0, scale), "cosine": dist.Normal(0.0, scale)}

    def suits(self, port: Port) -> bool:
        """Returns whether the joint turns."""
        return port.coordinate == "rad"

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns a sin N q + b cos N q."""
        sin, cos = self.columns(position, velocity)
        return parameters["sine"] * sin + parameters["cosine"] * cos

    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns sin N q and cos N q."""
        angle = self.order * position
        return torch.sin(angle), torch.cos(angle)

    @property
    def constants(self) -> dict[str, float]:
        """The number of periods per turn."""
        return {"order": self.order}

    def with_ripples(self, number: int) -> Self:
        """Returns the effect with another number of periods per turn."""
        changed = copy.copy(self)
        changed.order = number
        return changed

    def __repr__(self) -> str:
        return f"Cogging(port={self.port!r}, order={self.order!r})"


class PeriodicDisturbance(TimedForceEffect):
    """a sin ωt + b cos ωt with ω = 2π f and the time t since the rollout began."""

    id = "periodic_disturbance"
    parameters = (
        Parameter("sine", "{port}", 0.0, "amplitude a of the sine"),
        Parameter("cosine", "{port}", 0.0, "amplitude b of the cosine"),
        Parameter("frequency", "Hz", 2.0, "frequency f"),
    )
    strength = ("sine", "cosine")
    wave = "frequency"
    contains = ("bias",)
    beside = ("bias",)
    law = "a sin ωt + b cos ωt"
    excitation = "hold"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Amplitudes normal, 3 % of the rated force each; frequency log-normal about 2 Hz."""
        scale = 0.03 * port.rated
        return {
            "sine": dist.Normal(0.0, scale),
            "cosine": dist.Normal(0.0, scale),
            "frequency": dist.LogNormal(math.log(2.0), 1.0),
        }

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """Returns the force at the step's start."""
        angle = 2.0 * math.pi * parameters["frequency"] * memory
        return parameters["sine"] * torch.sin(angle) + parameters["cosine"] * torch.cos(angle)


class Wind(ForceEffect):
    """A u|u|/w² with u = w cos(q − ψ) − q̇: drag relative to air that moves at a constant w.

    At the joint angle ψ the body that turns with the joint faces the wind. At rest at this angle,
    the wind's force is A.
    """

    id = "wind"
    parameters = (
        Parameter("force", "{port}", 0.0, "force A head-on at rest"),
        Parameter("speed", "{coordinate}/s", 10.0, "speed w of the wind over the lever"),
        Parameter("direction", "rad", 0.0, "joint angle ψ that faces the wind"),
    )
    strength = ("force",)
    contains = ("quadratic_drag",)
    law = "A u|u|/w², u = w cos(q − ψ) − q̇"
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Force half-normal, 3 % of rated; speed about 10 per second; any direction."""
        return {
            "force": dist.HalfNormal(0.03 * port.rated),
            "speed": dist.LogNormal(math.log(10.0), 0.5),
            "direction": dist.Uniform(-math.pi, math.pi),
        }

    def suits(self, port: Port) -> bool:
        """Returns whether the joint turns; on a sliding joint, wind is a bias and drag."""
        return port.coordinate == "rad"

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Any
    ) -> Tensor:
        """Returns A u|u|/w²."""
        facing = torch.cos(position - parameters["direction"])
        relative = facing - velocity / parameters["speed"]
        return parameters["force"] * relative * relative.abs()


class ParameterDrift(ParameterEffect):
    """θ (1 + ρ t): a domain parameter that drifts with the time t since the rollout began.

    It models the trend of a random walk. It is evaluated at each segment's middle and constant
    within it, so it has an effect only if rollouts are divided into segments.
    """

    id = "parameter_drift"
    parameters = (Parameter("rate", "1/s", 0.0, "relative drift per time ρ"),)
    law = "θ (1 + ρ t)"
    excitation = "long_run"
    reference = BITTENCOURT_2012

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 5 % per minute."""
        return {"rate": dist.Normal(0.0, 0.05 / 60.0)}

    def change(self, value: Tensor, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns θ (1 + ρ t)."""
        return value * (1.0 + parameters["rate"] * time)
