"""Friction with a state, or that depends on the load of the joint."""

import math
from collections.abc import Mapping

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import ForceEffect
from npdr_ppl.models.effects.references import BITTENCOURT_2012, CANUDAS_1995
from npdr_ppl.models.effects.timed import TimedForceEffect

__all__ = ["FrictionDrift", "LoadDependentFriction", "PreslidingFriction"]


class PreslidingFriction(ForceEffect):
    """−F (x + τ ẋ) with ẋ = (v − |v| x)/z_s: bristles that bend by z_s before they slide.

    This is the LuGre model with g(v) = F, bristle stiffness σ₀ = F/z_s, damping σ₁ = τ σ₀ and x =
    z/z_s within ±1. With τ = 0 it is Dahl's model. In steady sliding it is Coulomb friction of
    magnitude F, which it replaces.

    Bristles are stiff, so a step is solved implicitly. With the displacement D z_s during a step
    of length h, x' = (x + D)/(1 + |D|), and D follows from the force at x'. If the joint moves at
    the start of a segment, its bristles start fully bent.
    """

    id = "presliding_friction"
    parameters = (
        Parameter("magnitude", "{port}", 0.0, "friction F in steady sliding"),
        Parameter("deflection", "{coordinate}", 2e-3, "bristle deflection z_s"),
        Parameter("relaxation", "s", 1e-3, "bristle damping over stiffness τ = σ₁/σ₀"),
    )
    strength = ("magnitude",)
    incidental = ("relaxation",)
    needs_joint = True
    contains = ("coulomb_friction",)
    law = "−F (x + τ ẋ), ẋ = (v − |v| x)/z_s"
    excitation = "reversals"
    reference = CANUDAS_1995

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Magnitude half-normal, 5 % of rated; deflection about 2e-3, relaxation about 1 ms."""
        return {
            "magnitude": dist.HalfNormal(0.05 * port.rated),
            "deflection": dist.LogNormal(math.log(2e-3 * port.rated_position), 0.8),
            "relaxation": dist.LogNormal(math.log(1e-3), 0.8),
        }

    def initial_memory(
        self, position: Tensor, velocity: Tensor, start: Start
    ) -> tuple[Tensor, Tensor]:
        """Returns bristles bent by the motion, and zero force."""
        return velocity.sign(), torch.zeros_like(velocity)

    def begin_step(
        self,
        joint: Joint,
        parameters: Mapping[str, Tensor],
        memory: tuple[Tensor, Tensor],
        time_step: float,
    ) -> tuple[Tensor, Tensor]:
        """Returns the bristles at the step's end, and the force during it.

        D = D₀ + κ r x − κ (1 + r) (x + D)/(1 + |D|) with the displacement D₀ without friction,
        κ = h² W F/z_s and r = τ/h. It increases in D, and is quadratic on either side of zero.
        """
        bristles, _ = memory
        magnitude, deflection = parameters["magnitude"], parameters["deflection"]
        memory_share = parameters["relaxation"] / time_step
        stiffness = time_step**2 * joint.inverse_inertia * magnitude / deflection
        free = time_step * (joint.velocity + time_step * joint.acceleration) / deflection
        free = free + stiffness * memory_share * bristles
        stiffness = stiffness * (1.0 + memory_share)
        # The residual of the equation at D = 0. D has its sign; mirror to D ≥ 0.
        excess = free - stiffness * bristles
        side = torch.where(excess < 0.0, -1.0, 1.0).to(excess)
        linear = 1.0 - side * free + stiffness
        root = torch.sqrt(linear * linear + 4.0 * excess.abs())
        # Of the two forms of the root, take the one without cancellation. The other's divisor
        # is kept away from zero, because its gradient must be finite.
        is_positive = linear > 0.0
        divisor = torch.where(is_positive, linear + root, torch.ones_like(root))
        size = torch.where(is_positive, 2.0 * excess.abs() / divisor, 0.5 * (root - linear))
        bent = (bristles + side * size) / (1.0 + size)
        force = -magnitude * (bent + memory_share * (bent - bristles))
        return bent, force

    def force(
        self,
        position: Tensor,
        velocity: Tensor,
        parameters: Mapping[str, Tensor],
        memory: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Returns the force during the step."""
        return memory[1]


class LoadDependentFriction(ForceEffect):
    """−μ |τ| sign v: dry friction in proportion to the drive's force τ, as in a loaded gear.

    τ is the generalised force of the actions at the joint, at the step's start.
    """

    id = "load_dependent_friction"
    parameters = (Parameter("coefficient", "1", 0.0, "friction per load μ"),)
    needs_joint = True
    needs_only_drive = True
    law = "−μ |τ| sign v"
    excitation = "hold"
    reference = BITTENCOURT_2012

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 20 % of the load. Small gears of servos can lose 40 %."""
        return {"coefficient": dist.HalfNormal(0.2)}

    def suits(self, port: Port) -> bool:
        """Returns whether a drive acts on the joint."""
        return port.is_driven

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> Tensor:
        """Returns a load of zero."""
        return torch.zeros_like(position)

    def begin_step(
        self, joint: Joint, parameters: Mapping[str, Tensor], memory: Tensor, time_step: float
    ) -> Tensor:
        """Returns |τ|."""
        return joint.drive.abs()

    def dry_friction(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """Returns μ |τ|."""
        return parameters["coefficient"] * memory


class FrictionDrift(TimedForceEffect):
    """−(F sign v + b v) exp(−t/T): friction of a cold device that vanishes as it warms up.

    Attach it together with the friction that remains. A rollout is assumed to begin cold, because
    earlier motion is not recorded. Temperature is not recorded either; the time t since the
    rollout began takes its place.
    """

    id = "friction_drift"
    parameters = (
        Parameter("dry", "{port}", 0.0, "dry friction F when cold, beyond that when warm"),
        Parameter("viscous", "{port} s/{coordinate}", 0.0, "likewise viscous friction b"),
        Parameter("time_constant", "s", 60.0, "time constant T of warming up"),
    )
    strength = ("dry", "viscous")
    contains = ("coulomb_friction", "viscous_friction")
    law = "−(F sign v + b v) exp(−t/T)"
    excitation = "long_run"
    reference = BITTENCOURT_2012

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal, 2 % of rated dry and 4 % viscous; time constant about a minute."""
        return {
            "dry": dist.HalfNormal(0.02 * port.rated),
            "viscous": dist.HalfNormal(0.04 * port.rated / port.rated_speed),
            "time_constant": dist.LogNormal(math.log(60.0), 1.0),
        }

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """Returns −b exp(−t/T) v."""
        return -parameters["viscous"] * _cold(parameters, memory) * velocity

    def dry_friction(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """Returns F exp(−t/T)."""
        return parameters["dry"] * _cold(parameters, memory)


def _cold(parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
    return torch.exp(-time / parameters["time_constant"])
