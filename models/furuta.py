"""The Furuta pendulum: a pole on a rotating arm, driven by a DC motor (Quanser Qube)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.ode.simulator import Forces, ODESimulator
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.noise import Noise
from npdr_ppl.language.sites import simulate
from npdr_ppl.models.furuta_inverse_dynamics import FurutaInverseDynamics

__all__ = ["Furuta", "SwingUpReward", "furuta", "furuta_paper", "initial_states"]


class FurutaConstants(NamedTuple):
    """Combinations of the parameters in the equations of motion, see :class:`Furuta`.

    Those of the pole's equation are divided by c₃. The arm's inertia once α̈ is eliminated is
    c₀ + c₁ sin²α − c₂²/c₃ cos²α = ``greatest_inertia`` − ``inertia_drop`` cos²α. ``lateral`` holds
    the tilted gravity's terms: (M_p L_r g_x, M_p L_r g_y, M_p L_p g_x/2, M_p L_p g_y/2, the last
    two also over c₃).
    """

    motor_gain: Tensor
    arm_drag: Tensor
    twice_c1: Tensor
    c2: Tensor
    greatest_inertia: Tensor
    inertia_drop: Tensor
    coupling: Tensor
    half_centrifugal: Tensor
    pole_drag: Tensor
    pole_gravity: Tensor
    inverse_c3: Tensor
    lateral: tuple[Tensor, ...] | None


class Furuta(ODESimulator):
    """The paper's equations of the Furuta pendulum; pole angle 0 is hanging, π upright.

    With arm angle θ, pole angle α, voltage V, arm inertia J_r = M_r L_r²/12 about the motor's
    axis, pole inertia J_p = M_p L_p²/12, c₀ = J_r + M_p L_r², c₁ = M_p L_p²/4,
    c₂ = M_p L_p L_r/2, c₃ = J_p + c₁, c₄ = M_p L_p g/2:

        (c₀ + c₁ sin²α) θ̈ + c₂ cos α α̈ = k_m (V − k_m θ̇)/R_m − D_r θ̇
                                          − c₁ sin 2α θ̇ α̇ + c₂ sin α α̇²
        c₂ cos α θ̈ + c₃ α̈ = −D_p α̇ + (c₁/2) sin 2α θ̇² − c₄ sin α

    For a thin rod, c₃ would replace c₁. The paper's equations are kept here: where the arm turns
    the pole, they treat it as a point mass at its centre.

    Gravity enters as a vector in the base's frame, z up, the arm along x at θ = 0. The pole's
    centre is L_r r + (L_p/2)(sin α t − cos α z) with r = (cos θ, sin θ, 0) and t = ∂r/∂θ, and the
    arm is balanced. The generalised forces of gravity g are therefore

        Q_θ = M_p (L_r t − (L_p/2) sin α r)·g,    Q_α = M_p (L_p/2)(cos α t + sin α z)·g.

    A payload is a point mass m at the pole's end: it adds m L_r² to c₀, m L_p² to c₁ and c₃,
    m L_p L_r to c₂ and m L_p to M_p L_p/2.

    Reference: Muratore et al., Neural Posterior Domain Randomization, CoRL 2021.
    """

    states = (
        Channel("arm_angle", "rad", -math.radians(115.0), math.radians(115.0)),
        Channel("pole_angle", "rad", -4.0 * math.pi, 4.0 * math.pi),
        Channel("arm_velocity", "rad/s", -20.0 * math.pi, 20.0 * math.pi, "arm_angle"),
        Channel("pole_velocity", "rad/s", -20.0 * math.pi, 20.0 * math.pi, "pole_angle"),
    )
    actions = (Channel("voltage", "V", -4.0, 4.0),)
    sensors = states
    parameters = (
        Parameter("gravity", "m/s²", 9.81, "acceleration of gravity g"),
        Parameter("motor_resistance", "Ω", 8.4, "terminal resistance R_m"),
        Parameter("motor_constant", "V s/rad", 0.042, "torque and back-EMF constant k_m"),
        Parameter("arm_mass", "kg", 0.095, "M_r"),
        Parameter("arm_length", "m", 0.085, "L_r"),
        Parameter("pole_mass", "kg", 0.024, "M_p"),
        Parameter("pole_length", "m", 0.129, "L_p"),
        Parameter("arm_damping", "N m s/rad", 5e-6, "viscous friction D_r"),
        Parameter("pole_damping", "N m s/rad", 1e-6, "viscous friction D_p"),
    )
    joints = ("arm", "pole")
    ports = (
        Port("voltage", "action", "V", rated=4.0),
        # The motor's stall torque at 4 V, and the pole's maximum gravity torque.
        Port("arm", "force", "N m", rated=0.02, rated_speed=10.0),
        Port("pole", "force", "N m", rated=0.015, rated_speed=20.0, is_driven=False),
        Port("arm_angle", "sensor", "rad", rated=1.0),
        Port("pole_angle", "sensor", "rad", rated=math.pi),
        Port("arm_velocity", "sensor", "rad/s", rated=10.0),
        Port("pole_velocity", "sensor", "rad/s", rated=20.0),
        Port("gravity", "environment", "m/s²", rated=9.81),
        Port("payload", "environment", "kg", rated=0.024),
    )
    time_step = 0.002
    default_integrator = "constant-acceleration"
    inverse_dynamics = FurutaInverseDynamics()

    def constants(
        self, parameters: Mapping[str, Tensor], environment: Mapping[str, Any]
    ) -> FurutaConstants:
        """Combines the parameters once."""
        p = parameters
        pole_mass, arm_length = p["pole_mass"], p["arm_length"]
        moment = 0.5 * pole_mass * p["pole_length"]  # M_p L_p/2
        c1 = 0.5 * moment * p["pole_length"]
        inverse_c3 = 0.75 / c1
        end_mass = pole_mass  # mass at the arm's end
        payload = environment["payload"]
        if isinstance(payload, Tensor):
            extra = payload * p["pole_length"]
            end_mass = end_mass + payload
            moment = moment + extra
            c1 = c1 + extra * p["pole_length"]
            # A factor that is exactly 1 without payload.
            inverse_c3 = inverse_c3 / (1.0 + extra * p["pole_length"] * inverse_c3)
        c0 = (p["arm_mass"] / 12.0 + end_mass) * arm_length * arm_length
        c2 = moment * arm_length
        coupling = c2 * inverse_c3
        motor_gain = p["motor_constant"] / p["motor_resistance"]
        x, y, z = environment["gravity"]
        lateral = None
        if isinstance(x, Tensor) or isinstance(y, Tensor):
            arm = end_mass * arm_length
            x, y = torch.as_tensor(x).to(arm), torch.as_tensor(y).to(arm)
            pole = (moment * x, moment * y)
            lateral = (arm * x, arm * y, *pole, pole[0] * inverse_c3, pole[1] * inverse_c3)
        return FurutaConstants(
            motor_gain=motor_gain,
            arm_drag=motor_gain * p["motor_constant"] + p["arm_damping"],
            twice_c1=2.0 * c1,
            c2=c2,
            greatest_inertia=c0 + c1,
            inertia_drop=c1 + c2 * coupling,
            coupling=coupling,
            half_centrifugal=c1 * inverse_c3,
            pole_drag=p["pole_damping"] * inverse_c3,
            pole_gravity=moment * z * inverse_c3,
            inverse_c3=inverse_c3,
            lateral=lateral,
        )

    def accelerations(
        self,
        positions: Components,
        velocities: Components,
        actions: Components,
        forces: Forces,
        constants: FurutaConstants,
    ) -> Components:
        """Returns (θ̈, α̈). The pole's equation is divided by c₃ and α̈ is eliminated.

        Products and sums are fused, because the number of operations limits eager simulations.
        """
        k = constants
        theta, alpha = positions
        theta_rate, alpha_rate = velocities
        sin, cos = torch.sin(alpha), torch.cos(alpha)
        arm = torch.addcmul(k.motor_gain * actions[0], k.arm_drag, theta_rate, value=-1.0)
        pole = torch.addcmul(k.pole_gravity * sin, k.pole_drag, alpha_rate, value=-1.0)
        # Without effects, forces are the number zero.
        if isinstance(forces[0], Tensor) or forces[0] != 0.0:
            arm = arm + forces[0]
        if isinstance(forces[1], Tensor) or forces[1] != 0.0:
            pole = pole + forces[1] * k.inverse_c3
        if k.lateral is not None:
            arm_x, arm_y, pole_x, pole_y, pole_x_c3, pole_y_c3 = k.lateral
            sin_theta, cos_theta = torch.sin(theta), torch.cos(theta)
            arm = arm + (arm_y * cos_theta - arm_x * sin_theta)
            arm = arm - sin * (pole_x * cos_theta + pole_y * sin_theta)
            pole = pole + cos * (pole_y_c3 * cos_theta - pole_x_c3 * sin_theta)
        spin = cos * sin * theta_rate
        pole = torch.addcmul(pole, k.half_centrifugal * spin, theta_rate)
        # c₂ sin α α̇² − c₁ sin 2α θ̇ α̇
        per_rate = torch.addcmul(k.c2 * sin * alpha_rate, k.twice_c1, spin, value=-1.0)
        arm = torch.addcmul(arm, per_rate, alpha_rate)
        inertia = torch.addcmul(k.greatest_inertia, k.inertia_drop, cos * cos, value=-1.0)
        arm_acceleration = torch.addcmul(arm, k.c2 * cos, pole, value=-1.0) / inertia
        turned = torch.addcmul(pole, k.coupling * cos, arm_acceleration, value=-1.0)
        return arm_acceleration, turned

    def inverse_inertia(
        self, positions: Components, velocities: Components, constants: FurutaConstants
    ) -> tuple[Components, ...]:
        """Returns the inverse of the mass matrix."""
        k = constants
        cos = torch.cos(positions[1])
        pole_per_arm = k.coupling * cos
        arm = 1.0 / (k.greatest_inertia - k.inertia_drop * cos * cos)
        cross = -pole_per_arm * arm
        return (arm, cross), (cross, k.inverse_c3 - pole_per_arm * cross)


@dataclass(frozen=True)
class SwingUpReward:
    """exp(−(eᵀQe + r V²)), where e is the error from upright, its pole angle wrapped to ±π.

    Args:
        arm_angle_weight: Q of the arm angle: 1.0 in the paper's simulations, 0.3 on its device.
        pole_angle_weight: Q of the pole angle.
        arm_velocity_weight: Q of the arm's rate.
        pole_velocity_weight: Q of the pole's rate.
        voltage_weight: r, on the commanded voltage before it is limited.
    """

    arm_angle_weight: float = 0.3
    pole_angle_weight: float = 1.0
    arm_velocity_weight: float = 0.02
    pole_velocity_weight: float = 0.005
    voltage_weight: float = 0.004

    def __call__(
        self, positions: Components, velocities: Components, commands: Components
    ) -> Tensor:
        """Returns the reward of a step, at most 1, from its initial state and its command."""
        error = positions[1] - math.pi
        error = error - 2.0 * math.pi * torch.round(error * (0.5 / math.pi))
        cost = self.arm_angle_weight * positions[0] * positions[0]
        cost = cost + self.pole_angle_weight * error * error
        cost = cost + self.arm_velocity_weight * velocities[0] * velocities[0]
        cost = cost + self.pole_velocity_weight * velocities[1] * velocities[1]
        return torch.exp(-(cost + self.voltage_weight * commands[0] * commands[0]))


def initial_states(num_states: int, generator: torch.Generator) -> Tensor:
    """Draws states near hanging: uniform ±(2, 1, 0.5, 0.5) in degrees and degrees per second.

    Args:
        num_states: Number of states.
        generator: Source of randomness.

    Returns:
        States, ``(num_states, 4)``, in rad and rad/s.
    """
    halfwidth = torch.deg2rad(torch.tensor([2.0, 1.0, 0.5, 0.5]))
    return (2.0 * torch.rand(num_states, 4, generator=generator) - 1.0) * halfwidth


def furuta(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The Furuta pendulum with the zoo's prior, which covers plausible dampings.

    Args:
        inputs: Segments with :class:`Furuta`'s channels.
        noise: Measurement noise.
    """
    parameters = _rigid_body_prior()
    parameters["arm_damping"] = pyro.sample("arm_damping", dist.Uniform(0.0, 1e-3))
    parameters["pole_damping"] = pyro.sample("pole_damping", dist.Uniform(0.0, 1e-4))
    return simulate("trajectory", Furuta(), parameters, inputs, noise=noise)


def furuta_paper(inputs: Inputs, *, noise: Noise | None = None) -> Tensor:
    """The Furuta pendulum with the paper's prior, for reproducing the paper's tables.

    Args:
        inputs: Segments with :class:`Furuta`'s channels.
        noise: Measurement noise.
    """
    parameters = _rigid_body_prior()
    parameters["arm_damping"] = pyro.sample("arm_damping", dist.Uniform(0.0, 2.5e-5))
    parameters["pole_damping"] = pyro.sample("pole_damping", dist.Uniform(0.0, 5e-5))
    return simulate("trajectory", Furuta(), parameters, inputs, noise=noise)


# The paper's uniform priors as fractions of the nominal values.
_PRIOR_RANGES = {
    "gravity": (0.85, 1.15),
    "motor_resistance": (0.1, 1.9),
    "motor_constant": (0.2, 1.8),
    "arm_mass": (0.3, 1.7),
    "arm_length": (0.5, 1.5),
    "pole_mass": (0.3, 1.7),
    "pole_length": (0.5, 1.5),
}


def _rigid_body_prior() -> dict[str, Tensor]:
    """Samples all parameters except the dampings."""
    nominal = {parameter.name: parameter.nominal for parameter in Furuta.parameters}
    return {
        name: pyro.sample(name, dist.Uniform(low * nominal[name], high * nominal[name]))
        for name, (low, high) in _PRIOR_RANGES.items()
    }
