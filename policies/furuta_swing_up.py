"""Swing-up and balance of the Furuta pendulum: energy shaping, then a PD law near upright."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npdr_ppl.policies.base import Policy, PolicyParameter

__all__ = ["FurutaSwingUp"]


class SwingUpConstants(NamedTuple):
    """Coefficients of :class:`FurutaSwingUp`; energies are converted to volts."""

    kinetic: Tensor
    potential: Tensor
    deficit: Tensor
    centring: Tensor
    limit: Tensor
    arm_gain: Tensor
    pole_gain: Tensor
    arm_rate_gain: Tensor
    pole_rate_gain: Tensor


class FurutaSwingUp(Policy):
    """The hybrid controller used on the paper's device.

    Within 20° of upright, |1 + cos α| < 1 − cos 20°, it is a PD law on the error. The pole's error
    is wrapped to ±π:

        V = K · (0 − θ, π − α, −θ̇, −α̇);

    otherwise it is energy shaping, with the pole's energy about its centre,

        E = ½ (M_p L_p²/12) α̇² + ½ M_p g L_p (1 − cos α),
        a = clip(k_E (E − E_ref) sign(α̇ cos α) − k_θ θ, ±5 m/s²),   V = (R_m/k_m) M_r L_r a.

    sign(0) is taken as 1. With 0 the energy term would vanish while the pole rests, and dry
    friction could keep it at rest.

    Args:
        parameters: log E_ref, log k_E, k_θ and the four gains K, shape ``(..., 7)``.
        internal_model: Parameters of the policy's own model, with the simulator's names, e.g. the
            most likely ones. Missing ones are taken from the episode's domain parameters.

    Reference: Muratore et al., Neural Posterior Domain Randomization, CoRL 2021.
    """

    observations = ("arm_angle", "pole_angle", "arm_velocity", "pole_velocity")
    actions = ("voltage",)
    parameter_info = (
        PolicyParameter("log_reference_energy", math.log(0.025), math.log(1e-3), math.log(0.5)),
        PolicyParameter("log_energy_gain", math.log(50.0), math.log(1.0), math.log(2e3)),
        PolicyParameter("centring_gain", 0.4, -20.0, 20.0),
        PolicyParameter("arm_gain", -2.0, -50.0, 50.0),
        PolicyParameter("pole_gain", 35.0, -200.0, 200.0),
        PolicyParameter("arm_rate_gain", -1.5, -20.0, 20.0),
        PolicyParameter("pole_rate_gain", 3.0, -20.0, 20.0),
    )

    max_acceleration = 5.0  # m/s², of the pivot
    balance_cone = 1.0 - math.cos(math.radians(20.0))

    def __init__(
        self,
        parameters: Tensor | None = None,
        *,
        internal_model: Mapping[str, Tensor | float] | None = None,
    ) -> None:
        super().__init__(parameters)
        self.internal_model = dict(internal_model or {})

    def constants(self, domain: Mapping[str, Tensor]) -> SwingUpConstants:
        """Combines gains and internal model."""
        log_reference, log_gain, centring, *gains = self.parameters.unbind(-1)
        p = {name: torch.as_tensor(x) for name, x in {**domain, **self.internal_model}.items()}
        resistance = p["motor_resistance"] / p["motor_constant"]
        volts = resistance * p["arm_mass"] * p["arm_length"]  # per m/s²
        gain = log_gain.exp() * volts
        weight = 0.5 * p["pole_mass"] * p["gravity"] * p["pole_length"]
        return SwingUpConstants(
            gain * p["pole_mass"] * p["pole_length"].square() / 24.0,
            gain * weight,
            gain * (weight - log_reference.exp()),
            centring * volts,
            self.max_acceleration * volts,
            *gains,
        )

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: SwingUpConstants,
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the voltage."""
        arm, pole, arm_rate, pole_rate = observation
        k = constants
        cos = torch.cos(pole)
        error = pole - math.pi
        error = error - 2.0 * math.pi * torch.round(error * (0.5 / math.pi))
        balance = k.arm_gain * arm + k.pole_gain * error
        balance = balance + k.arm_rate_gain * arm_rate + k.pole_rate_gain * pole_rate
        surplus = k.kinetic * pole_rate * pole_rate - k.potential * cos + k.deficit
        pumped = torch.where(pole_rate * cos >= 0.0, surplus, -surplus) - k.centring * arm
        swing = torch.minimum(torch.maximum(pumped, -k.limit), k.limit)
        return (torch.where(cos + 1.0 < self.balance_cone, -balance, swing),), memory
