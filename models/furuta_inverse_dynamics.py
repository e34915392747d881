"""The Furuta pendulum's equations of motion in the form for linear regression."""

from collections.abc import Mapping

import torch
from torch import Tensor

from npdr_ppl.language.linear_dynamics import BaseParameter, InverseDynamics, Motion

__all__ = ["FurutaInverseDynamics"]


class FurutaInverseDynamics(InverseDynamics):
    """The equations of :class:`~npdr_ppl.models.furuta.Furuta` in volts.

    The symbols are the same. Division by the motor's gain K = k_m/R_m leaves only the voltage on
    the right and turns the back-EMF into a damping:

        [c₀ θ̈ + c₁ (sin²α θ̈ + sin 2α θ̇ α̇) + c₂ (cos α α̈ − sin α α̇²) + (D_r + K k_m) θ̇]/K = V
        [c₁ (⁴⁄₃ α̈ − ½ sin 2α θ̇²) + c₂ cos α θ̈ + c₄ sin α + D_p α̇]/K = 0

    The motion therefore determines six combinations. Motor and gravity must be known, and the
    masses are proportional to K.
    """

    base = (
        BaseParameter("arm_inertia_per_gain", "V s²", "(J_r + M_p L_r²)/K"),
        BaseParameter("pole_inertia_per_gain", "V s²", "M_p L_p²/(4 K)"),
        BaseParameter("coupling_per_gain", "V s²", "M_p L_p L_r/(2 K)"),
        BaseParameter("pole_weight_per_gain", "V", "M_p L_p g/(2 K)"),
        BaseParameter("arm_damping_per_gain", "V s", "D_r/K + k_m"),
        BaseParameter("pole_damping_per_gain", "V s", "D_p/K"),
    )
    determined = (
        "arm_mass",
        "arm_length",
        "pole_mass",
        "pole_length",
        "arm_damping",
        "pole_damping",
    )
    positive = (
        "arm_mass",
        "arm_length",
        "pole_mass",
        "pole_length",
        "gravity",
        "motor_resistance",
        "motor_constant",
    )
    non_negative = ("arm_damping", "pole_damping")

    def regressors(self, motion: Motion) -> Tensor:
        """Returns Y, ``(N, 2, 6)``."""
        _, alpha = motion.positions
        theta_rate, alpha_rate = motion.velocities
        theta_acceleration, alpha_acceleration = motion.accelerations
        sin, cos = torch.sin(alpha), torch.cos(alpha)
        double, zero = torch.sin(2.0 * alpha), torch.zeros_like(alpha)
        arm = (
            theta_acceleration,
            sin * sin * theta_acceleration + double * theta_rate * alpha_rate,
            cos * alpha_acceleration - sin * alpha_rate * alpha_rate,
            zero,
            theta_rate,
            zero,
        )
        pole = (
            zero,
            4.0 / 3.0 * alpha_acceleration - 0.5 * double * theta_rate * theta_rate,
            cos * theta_acceleration,
            sin,
            zero,
            alpha_rate,
        )
        return torch.stack((torch.stack(arm, dim=-1), torch.stack(pole, dim=-1)), dim=-2)

    def targets(self, motion: Motion) -> Tensor:
        """Returns the voltage for the arm and zero for the pole, ``(N, 2)``, in V."""
        (voltage,) = motion.actions
        return torch.stack((voltage, torch.zeros_like(voltage)), dim=-1)

    def to_base(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the six combinations."""
        p = parameters
        scale = self.force_scale(p)
        moment = 0.5 * p["pole_mass"] * p["pole_length"] * scale
        arm_length = p["arm_length"]
        return torch.stack(
            (
                (p["arm_mass"] / 12.0 + p["pole_mass"]) * arm_length * arm_length * scale,
                0.5 * moment * p["pole_length"],
                moment * arm_length,
                moment * p["gravity"],
                p["arm_damping"] * scale + p["motor_constant"],
                p["pole_damping"] * scale,
            ),
            dim=-1,
        )

    def to_physical(self, base: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns masses, lengths and dampings under the given motor and gravity."""
        gain = 1.0 / self.force_scale(given)
        c0, c1, c2, weight, arm_drag, pole_drag = base.unbind(-1)
        moment = weight / given["gravity"]
        pole_length = 2.0 * c1 / moment
        pole_mass = 2.0 * moment / pole_length * gain
        arm_length = c2 / moment
        square = arm_length * arm_length
        return {
            "arm_mass": 12.0 * (c0 * gain / square - pole_mass),
            "arm_length": arm_length,
            "pole_mass": pole_mass,
            "pole_length": pole_length,
            "arm_damping": (arm_drag - given["motor_constant"]) * gain,
            "pole_damping": pole_drag * gain,
        }

    def force_scale(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns 1/K = R_m/k_m, in V/(N m)."""
        return parameters["motor_resistance"] / parameters["motor_constant"]
