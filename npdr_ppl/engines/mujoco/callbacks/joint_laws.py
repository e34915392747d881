"""Laws of forces at a joint, as numbers of one simulation."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

__all__ = [
    "AsymmetricCoulombFriction",
    "Backlash",
    "Bias",
    "Cogging",
    "CoulombFriction",
    "FrictionDrift",
    "HardeningSpring",
    "Joint",
    "JointElasticity",
    "JointLaw",
    "JointPlace",
    "LoadDependentFriction",
    "PeriodicDisturbance",
    "PreslidingFriction",
    "QuadraticDrag",
    "Spring",
    "StribeckFriction",
    "Unbalance",
    "ViscousFriction",
    "Wind",
]


@dataclass
class Joint:
    """State of a joint at the start of an engine step, in SI units.

    Attributes:
        position: Position q.
        velocity: Velocity v.
        time: Time in the middle of the step, for which forces are constant.
        step: Length h of the step.
        acceleration: Acceleration without dry friction of effects; only for laws that need it.
        inverse_inertia: Acceleration per force at the joint; likewise.
        drive: Force of the actuators at the joint; likewise.
    """

    position: float
    velocity: float
    time: float
    step: float
    acceleration: float = 0.0
    inverse_inertia: float = 0.0
    drive: float = 0.0


JointPlace = str | int | tuple[str | int, int]
"""Name or number of a hinge or slide; for a free joint or a ball, the same and the number
of the degree of freedom: a free joint has forces along the body's own axes, then torques about
them, and a ball has torques."""


@dataclass
class JointLaw:
    """A force at a joint, constant during an engine step.

    Attributes:
        joint: Where it acts.
        needs_dynamics: Whether it needs the joint's acceleration, inertia and drive.
    """

    joint: JointPlace
    needs_dynamics: ClassVar[bool] = False

    def reset(self, velocity: float) -> None:
        """Sets the law's own state at the start of a rollout."""

    def begin(self, joint: Joint) -> None:
        """Advances the own state by a step, if the law needs dynamics."""

    def finish(self, joint: Joint) -> None:
        """Advances the own state to the next step, once the forces of this one are known."""

    def applied_force(self, joint: Joint) -> float:
        """Returns a force in N m or N."""
        return 0.0

    def dry_friction(self, joint: Joint) -> float:
        """Returns the greatest force of dry friction, which acts against the motion."""
        return 0.0


def sign(value: float) -> float:
    """Returns -1, 0 or 1."""
    return float((value > 0.0) - (value < 0.0))


@dataclass
class ViscousFriction(JointLaw):
    """−b v."""

    damping: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        return -self.damping * joint.velocity


@dataclass
class CoulombFriction(JointLaw):
    """−F sign v in motion; at rest the force that keeps the joint at rest, up to F."""

    magnitude: float

    def dry_friction(self, joint: Joint) -> float:
        """Returns F."""
        return self.magnitude


@dataclass
class AsymmetricCoulombFriction(JointLaw):
    """Dry friction F₊ in forward and F₋ in backward motion."""

    forward: float
    backward: float

    def dry_friction(self, joint: Joint) -> float:
        """Returns the bound in the present direction; at rest the smaller one."""
        if joint.velocity == 0.0:
            return min(self.forward, self.backward)
        return self.forward if joint.velocity > 0.0 else self.backward


@dataclass
class StribeckFriction(JointLaw):
    """Additional dry friction near rest: ΔF exp(−|v/v_s|)."""

    excess: float
    speed: float

    def dry_friction(self, joint: Joint) -> float:
        """Returns the bound."""
        return self.excess * math.exp(-abs(joint.velocity) / self.speed)


@dataclass
class PreslidingFriction(JointLaw):
    """−F (x + τ ẋ) with ẋ = (v − |v| x)/z_s: bristles bend by z_s before they slide.

    Bristles are stiff, so a step is solved implicitly for the displacement d (in units of z_s) in
    which the joint and its bristles agree.
    """

    magnitude: float
    deflection: float
    relaxation: float
    bend: float = field(default=0.0, init=False, repr=False)
    held: float = field(default=0.0, init=False, repr=False)
    needs_dynamics: ClassVar[bool] = True

    def reset(self, velocity: float) -> None:
        """Bends the bristles fully if the joint moves."""
        self.bend, self.held = sign(velocity), 0.0

    def begin(self, joint: Joint) -> None:
        """Solves for the bristles at the step's end, and the force during the step."""
        h, ratio = joint.step, self.relaxation / joint.step
        stiffness = h * h * joint.inverse_inertia * self.magnitude / self.deflection
        free = h * (joint.velocity + h * joint.acceleration) / self.deflection
        free += stiffness * ratio * self.bend
        stiffness *= 1.0 + ratio
        excess = free - stiffness * self.bend
        side = -1.0 if excess < 0.0 else 1.0
        linear = 1.0 - side * free + stiffness
        root = math.sqrt(linear * linear + 4.0 * abs(excess))
        # The form of the root without cancellation.
        size = 2.0 * abs(excess) / (linear + root) if linear > 0.0 else 0.5 * (root - linear)
        bent = (self.bend + side * size) / (1.0 + size)
        self.held = -self.magnitude * (bent + ratio * (bent - self.bend))
        self.bend = bent

    def applied_force(self, joint: Joint) -> float:
        """Returns the force during the step."""
        return self.held


@dataclass
class QuadraticDrag(JointLaw):
    """−c v|v|."""

    drag: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        return -self.drag * joint.velocity * abs(joint.velocity)


@dataclass
class LoadDependentFriction(JointLaw):
    """Dry friction μ |τ| in proportion to the drive's force τ at the step's start."""

    coefficient: float
    load: float = field(default=0.0, init=False, repr=False)
    needs_dynamics: ClassVar[bool] = True

    def reset(self, velocity: float) -> None:
        """Starts without load."""
        self.load = 0.0

    def begin(self, joint: Joint) -> None:
        """Reads the load."""
        self.load = abs(joint.drive)

    def dry_friction(self, joint: Joint) -> float:
        """Returns the bound."""
        return self.coefficient * self.load


@dataclass
class FrictionDrift(JointLaw):
    """Dry friction F and damping b that vanish as exp(−t/T) while the device warms up."""

    dry: float
    viscous: float
    time_constant: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the viscous part."""
        return -self.viscous * math.exp(-joint.time / self.time_constant) * joint.velocity

    def dry_friction(self, joint: Joint) -> float:
        """Returns the bound of the dry part."""
        return self.dry * math.exp(-joint.time / self.time_constant)


@dataclass
class Bias(JointLaw):
    """A constant force c."""

    offset: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        return self.offset


@dataclass
class Spring(JointLaw):
    """−k (q − q₀)."""

    stiffness: float
    rest: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        return -self.stiffness * (joint.position - self.rest)


@dataclass
class HardeningSpring(JointLaw):
    """−k₃ q³."""

    stiffness: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        return -self.stiffness * joint.position**3


@dataclass
class Unbalance(JointLaw):
    """a sin q + b cos q."""

    sine: float
    cosine: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        return self.sine * math.sin(joint.position) + self.cosine * math.cos(joint.position)


@dataclass
class Cogging(JointLaw):
    """a sin N q + b cos N q: a ripple with N periods per turn."""

    sine: float
    cosine: float
    order: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        angle = self.order * joint.position
        return self.sine * math.sin(angle) + self.cosine * math.cos(angle)


@dataclass
class PeriodicDisturbance(JointLaw):
    """a sin 2πft + b cos 2πft."""

    sine: float
    cosine: float
    frequency: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        angle = 2.0 * math.pi * self.frequency * joint.time
        return self.sine * math.sin(angle) + self.cosine * math.cos(angle)


@dataclass
class Wind(JointLaw):
    """A u|u| with u = cos(q − ψ) − v/w: drag relative to air that moves at the speed w."""

    force: float
    speed: float
    direction: float

    def applied_force(self, joint: Joint) -> float:
        """Returns the force."""
        relative = math.cos(joint.position - self.direction) - joint.velocity / self.speed
        return self.force * relative * abs(relative)


@dataclass
class Transmission(JointLaw):
    """Motor and link joined by something that gives; the joint's position is the link's.

    The motor has the share ρ of the joint's inertia. The law's own state is the motor's advance
    relative to the link, and its rate.
    """

    motor_share: float
    advance: float | None = field(default=None, init=False, repr=False)
    rate: float = field(default=0.0, init=False, repr=False)
    held: float = field(default=0.0, init=False, repr=False)
    needs_dynamics: ClassVar[bool] = True

    def reset(self, velocity: float) -> None:
        """Leaves the advance to the first step."""
        self.advance, self.rate, self.held = None, 0.0, 0.0

    def pull(self, joint: Joint) -> float:
        """Returns the acceleration of the advance if nothing joined motor and link."""
        motor = joint.drive * joint.inverse_inertia / self.motor_share
        return (motor - joint.acceleration) / (1.0 - self.motor_share)

    def move(self, joint: Joint, advance: float, rate: float) -> None:
        """Sets advance and rate at the step's end, and the mean force on the link."""
        inertia = self.motor_share / joint.inverse_inertia
        self.held = -inertia * (rate - self.rate) / joint.step
        self.advance, self.rate = advance, rate

    def applied_force(self, joint: Joint) -> float:
        """Returns the mean force during the step."""
        return self.held


@dataclass
class JointElasticity(Transmission):
    """A spring and a damper between motor and link, solved exactly over a step.

    T is the inverse of the free resonance in rad/s, ζ its damping ratio.
    """

    time_constant: float
    damping_ratio: float

    def begin(self, joint: Joint) -> None:
        """Advances a damped oscillation about the settled deflection."""
        h, ratio = joint.step, min(self.damping_ratio, 0.999)
        # A resonance far above the step rate is rigid.
        frequency = 1.0 / max(self.time_constant, h / 1000.0)
        settled = self.pull(joint) * self.time_constant**2
        if self.advance is None:
            self.advance = settled
        decay, swing = ratio * frequency, frequency * math.sqrt(1.0 - ratio * ratio)
        offset = self.advance - settled
        other = (self.rate + decay * offset) / swing
        shrunk, sin, cos = math.exp(-decay * h), math.sin(swing * h), math.cos(swing * h)
        moved = shrunk * (offset * cos + other * sin)
        rate = shrunk * swing * (other * cos - offset * sin) - decay * moved
        self.move(joint, settled + moved, rate)


@dataclass
class Backlash(Transmission):
    """Play of half width g between motor and link, with inelastic impacts."""

    play: float

    def begin(self, joint: Joint) -> None:
        """Moves the motor freely until it reaches a flank."""
        h, pull = joint.step, self.pull(joint)
        if self.advance is None:
            self.advance = self.play * sign(pull)
        reached = self.advance + h * (self.rate + h * pull)
        reached = min(max(reached, -self.play), self.play)
        self.move(joint, reached, (reached - self.advance) / h)
