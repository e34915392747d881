"""What lies between a motor and the joint that it drives: elasticity and backlash.

Both split the joint's inertia. Of the inertia J = 1/W that a force at the joint sees, the share ρ
turns with the motor and the rest with the link; δ is how far the motor is ahead of the link. The
joint's own coordinate is the link's. With the drive's force τ, and the acceleration a that the
joint would have if it were rigid, the two masses obey, apart from the force s that joins them,

    ρ J (q̈ + δ̈) = τ − s,    q̈ = a + W f,    f = −ρ J δ̈,

where f is what the link feels more than in a rigid joint. Eliminating q̈ leaves

    δ̈ = (τ W/ρ − a − s W/ρ)/(1 − ρ),

which is solved within a step, so that stiff transmissions need no small steps.
"""

from collections.abc import Mapping

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects import ForceEffect
from npdr_ppl.models.effects.references import SPONG_1987, TAO_1996

__all__ = ["Backlash", "JointElasticity"]

_Memory = tuple[Tensor, ...]
"""How far the motor is ahead (NaN before it is known), the rate of that, the mean force; and the
force's moment within the step, where it has one."""

_SHARE = Parameter("motor_share", "1", 0.3, "share ρ of the inertia on the motor's side")

# A resonance at a thousand times the rate of the steps is rigid in any precision.
_STEPS_PER_LEAST_TIME_CONSTANT = 1000.0

# Beyond this damping ratio a joint hardly swings, and ω_d would vanish.
_GREATEST_DAMPING_RATIO = 0.999


def _pull(joint: Joint, share: Tensor) -> Tensor:
    """Returns δ̈ of a motor that nothing joins to its link."""
    return (joint.drive * joint.inverse_inertia / share - joint.acceleration) / (1.0 - share)


class _Transmission(ForceEffect):
    """What joins a motor to its link; how far the motor is ahead is found in the first step."""

    needs_joint = True

    def suits(self, port: Port) -> bool:
        """Returns whether a motor drives the joint."""
        return port.is_driven

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> _Memory:
        """Returns an advance that is not known yet."""
        zero = torch.zeros_like(position)
        return torch.full_like(position, torch.nan), zero, zero

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: _Memory
    ) -> Tensor:
        """Returns the mean force during the step."""
        return memory[2]


class JointElasticity(_Transmission):
    """s = k δ + d δ̇: a spring and a damper between motor and link.

    In terms of the free resonance ω = 1/T: δ̈ = p − ω² δ − 2 ζ ω δ̇ with the pull p of the drive,
    solved exactly over a step in which p is constant. A segment starts with the spring settled.
    """

    id = "joint_elasticity"
    parameters = (
        Parameter("time_constant", "s", 0.0, "T = 1/ω, over 2π the period of the resonance"),
        Parameter("damping_ratio", "1", 0.05, "damping ratio ζ of the resonance"),
        _SHARE,
    )
    strength = ("time_constant",)
    is_resonant = True
    law = "motor and link joined by k δ + d δ̇"
    excitation = "chirp"
    reference = SPONG_1987

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Resonance mostly above 10 Hz; damping ratio up to 0.3; any share but the extremes."""
        return {
            "time_constant": dist.HalfNormal(0.01),
            "damping_ratio": dist.Uniform(0.005, 0.3),
            "motor_share": dist.Uniform(0.05, 0.9),
        }

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> _Memory:
        """Returns a deflection that is not known yet, and no moment."""
        return *super().initial_memory(position, velocity, start), torch.zeros_like(position)

    def begin_step(
        self,
        joint: Joint,
        parameters: Mapping[str, Tensor],
        memory: _Memory,
        time_step: float,
    ) -> _Memory:
        """Returns deflection and rate at the step's end, and the mean force during it."""
        share = parameters["motor_share"]
        time_constant = parameters["time_constant"]
        ratio = parameters["damping_ratio"].clamp_max(_GREATEST_DAMPING_RATIO)
        least = time_step / _STEPS_PER_LEAST_TIME_CONSTANT
        frequency = 1.0 / time_constant.clamp_min(least)
        settled = _pull(joint, share) * time_constant * time_constant
        deflection, rate, *_ = memory
        deflection = torch.where(deflection.isnan(), settled, deflection)
        # A damped oscillation about the settled deflection.
        decay = ratio * frequency
        swing = frequency * torch.sqrt(1.0 - ratio * ratio)
        offset = deflection - settled
        other = (rate + decay * offset) / swing
        shrunk = torch.exp(-decay * time_step)
        sin, cos = torch.sin(swing * time_step), torch.cos(swing * time_step)
        moved = shrunk * (offset * cos + other * sin)
        next_rate = shrunk * swing * (other * cos - offset * sin) - decay * moved
        next_deflection = settled + moved
        motor_inertia = share / joint.inverse_inertia
        mean = -motor_inertia * (next_rate - rate) / time_step
        # With it the link is where the motor's advance has left it.
        ahead = 0.5 * time_step * (rate + next_rate) - (next_deflection - deflection)
        return next_deflection, next_rate, mean, -motor_inertia * ahead

    def moment(self, parameters: Mapping[str, Tensor], memory: _Memory) -> Tensor:
        """Returns the moment of the force: a joint may swing more than once within a step."""
        return memory[3]


class Backlash(_Transmission):
    """|δ| ≤ g: play of half width g between motor and link, which meet without a bounce.

    While the gap is open no drive reaches the link, and the link moves without the motor's
    inertia. A segment starts with the gap closed on the side to which the drive pushes.
    """

    id = "backlash"
    parameters = (Parameter("play", "{coordinate}", 0.0, "half width g of the gap"), _SHARE)
    strength = ("play",)
    is_smooth = False
    law = "motor ahead of the link by up to ±g"
    excitation = "reversals"
    reference = TAO_1996

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Play half-normal, 0.2 % of the rated position (7'); any share but the extremes."""
        return {
            "play": dist.HalfNormal(0.002 * port.rated_position),
            "motor_share": dist.Uniform(0.05, 0.9),
        }

    def begin_step(
        self,
        joint: Joint,
        parameters: Mapping[str, Tensor],
        memory: _Memory,
        time_step: float,
    ) -> _Memory:
        """Returns the motor's advance and its rate at the step's end, and the mean force."""
        share, play = parameters["motor_share"], parameters["play"]
        pull = _pull(joint, share)
        advance, rate, _ = memory
        advance = torch.where(advance.isnan(), play * pull.sign(), advance)
        free = advance + time_step * (rate + time_step * pull)
        reached = free.clamp(-play, play)
        # The rate that arrives at the end of the gap when the step ends, and zero once there.
        next_rate = (reached - advance) / time_step
        change = (next_rate - rate) / time_step
        return reached, next_rate, -share / joint.inverse_inertia * change
