"""Effects between a motor and the joint that it drives: elasticity and backlash.

Both split the joint's inertia. Of the inertia J = 1/W at the joint, the share ρ turns with the
motor and the rest with the link. δ is the motor's advance relative to the link, and the joint's
own coordinate is the link's. Let τ be the drive's force, s the force between the two masses, and a
the acceleration of a rigid joint. The two masses obey

    ρ J (q̈ + δ̈) = τ − s,    q̈ = a + W f,    f = −ρ J δ̈,

where f is the additional force on the link compared with a rigid joint. Eliminating q̈ leaves

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

_Memory = tuple[Tensor, Tensor, Tensor, Tensor]
"""The motor's advance (NaN before it is known), its rate, the mean force and the force's moment
within the step."""

_SHARE = Parameter("motor_share", "1", 0.3, "share ρ of the inertia on the motor's side")

# A resonance at a thousand times the step rate is rigid in any precision.
_STEPS_PER_LEAST_TIME_CONSTANT = 1000.0

# Above this damping ratio a joint hardly oscillates, and ω_d would vanish.
_GREATEST_DAMPING_RATIO = 0.999


def _pull(joint: Joint, share: Tensor) -> Tensor:
    """Returns δ̈ of a motor that is not connected to its link."""
    return (joint.drive * joint.inverse_inertia / share - joint.acceleration) / (1.0 - share)


class _Transmission(ForceEffect):
    """A connection of motor and link; the motor's advance is computed in the first step."""

    needs_joint = True

    def suits(self, port: Port) -> bool:
        """Returns whether a motor drives the joint."""
        return port.is_driven

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> _Memory:
        """Returns an unknown advance, NaN."""
        zero = torch.zeros_like(position)
        return torch.full_like(position, torch.nan), zero, zero, zero

    def force(
        self, position: Tensor, velocity: Tensor, parameters: Mapping[str, Tensor], memory: _Memory
    ) -> Tensor:
        """Returns the mean force during the step."""
        return memory[2]

    def moment(self, parameters: Mapping[str, Tensor], memory: _Memory) -> Tensor:
        """Returns the moment of the force: motors may reverse or hit often within a step."""
        return memory[3]


def _felt(
    joint: Joint,
    share: Tensor,
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    time_step: float,
) -> tuple[Tensor, Tensor]:
    """Returns mean and moment of the force on the link while the motor's advance changes.

    Args:
        joint: The joint.
        share: Motor's share of the inertia.
        before: The motor's advance and its rate at the step's start.
        after: The same at its end.
        time_step: Seconds per step.
    """
    motor_inertia = share / joint.inverse_inertia
    (advance, rate), (next_advance, next_rate) = before, after
    mean = -motor_inertia * (next_rate - rate) / time_step
    # The moment makes the link's position agree with the motor's advance.
    ahead = 0.5 * time_step * (rate + next_rate) - (next_advance - advance)
    return mean, -motor_inertia * ahead


class JointElasticity(_Transmission):
    """s = k δ + d δ̇: a spring and a damper between motor and link.

    In terms of the free resonance ω = 1/T: δ̈ = p − ω² δ − 2 ζ ω δ̇ with the drive's term p. It is
    solved exactly over a step, in which p is constant. A segment starts with the spring settled.
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
        """Resonance mostly above 10 Hz; damping ratio up to 0.3; any share except the extremes."""
        return {
            "time_constant": dist.HalfNormal(0.01),
            "damping_ratio": dist.Uniform(0.005, 0.3),
            "motor_share": dist.Uniform(0.05, 0.9),
        }

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
        before, after = (deflection, rate), (next_deflection, next_rate)
        return *after, *_felt(joint, share, before, after, time_step)


class Backlash(_Transmission):
    """|δ| ≤ g: play of half width g between motor and link, with inelastic impacts.

    While the gap is open, the drive does not act on the link, and the link moves without the
    motor's inertia. A segment starts with the gap closed on the side to which the drive pushes.
    """

    id = "backlash"
    parameters = (Parameter("play", "{coordinate}", 0.0, "half width g of the gap"), _SHARE)
    strength = ("play",)
    is_smooth = False
    has_local_minima = True
    law = "motor ahead of the link by up to ±g"
    excitation = "reversals"
    reference = TAO_1996

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Play half-normal, 0.2 % of the rated position (7'); any share except the extremes."""
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
        """Returns the motor's advance and its rate at the step's end, mean force and moment."""
        share, play = parameters["motor_share"], parameters["play"]
        pull = _pull(joint, share)
        advance, rate, *_ = memory
        advance = torch.where(advance.isnan(), play * pull.sign(), advance)
        before = advance, rate
        if joint.takes_moments:
            after = _flown(advance, rate, pull, play, time_step)
            return *after, *_felt(joint, share, before, after, time_step)
        reached = (advance + time_step * (rate + time_step * pull)).clamp(-play, play)
        # The rate with which the motor reaches the gap's end when the step ends, and zero once
        # there. The mean force alone then moves the link to the right position.
        after = reached, (reached - advance) / time_step
        mean, _ = _felt(joint, share, before, after, time_step)
        return *after, mean, torch.zeros_like(mean)


def _flown(
    advance: Tensor, rate: Tensor, pull: Tensor, play: Tensor, time_step: float
) -> tuple[Tensor, Tensor]:
    """Returns the motor's advance and its rate after a free motion that may end at a flank."""
    sides = [_time_to_flank(play, s * advance, s * rate, s * pull) for s in (-1.0, 1.0)]
    flight = torch.minimum(*sides).clamp_max(time_step)
    flank = torch.where(sides[0] < sides[1], -play, play)
    has_hit = torch.minimum(*sides) < time_step
    # Inelastic impact: after a hit the motor leaves the flank only if the drive pulls it off.
    left = time_step - flight
    off = torch.where(pull * flank < 0.0, pull, 0.0)
    reached = torch.where(
        has_hit,
        flank + 0.5 * off * left * left,
        advance + time_step * (rate + 0.5 * time_step * pull),
    )
    next_rate = torch.where(has_hit, off * left, rate + time_step * pull)
    within = reached.clamp(-play, play)
    return within, torch.where(within == reached, next_rate, 0.0)


def _time_to_flank(play: Tensor, advance: Tensor, rate: Tensor, pull: Tensor) -> Tensor:
    """Returns the time in s to the flank at +g; infinite if the free motion does not end there.

    The least root of g = δ + δ̇ t + p t²/2 that is not negative.
    """
    distance = (play - advance).clamp_min(0.0)
    discriminant = rate * rate + 2.0 * pull * distance
    # Branches that are not used must not make the derivatives infinite.
    is_real = discriminant > 0.0
    closing = rate + torch.where(is_real, discriminant, 1.0).sqrt()
    is_flight = is_real & (closing > 0.0)
    time = 2.0 * distance / torch.where(is_flight, closing, 1.0)
    rests = (distance == 0.0) & (rate == 0.0) & (pull >= 0.0)
    return torch.where(rests, 0.0, torch.where(is_flight, time, torch.inf))
