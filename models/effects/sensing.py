"""Effects between a true value and its measurement."""

from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import SensorEffect
from npdr_ppl.models.effects.equivalence import ANGLE_OFFSET, FIRST_ORDER_LAG, POSITION_SCALE
from npdr_ppl.models.effects.lag import remaining
from npdr_ppl.models.effects.references import LJUNG_1999, MUJOCO

__all__ = ["EncoderBias", "EncoderScale", "Quantisation", "SensorLowPass"]


class SensorLowPass(SensorEffect):
    """ẏ = (x − y)/T: a filtered measurement, e.g. a velocity derived from an encoder.

    Exact for velocities that are linear between samples and for positions that are parabolic. The
    measurement therefore lags by T at any sampling rate, as that of a driver that filters the
    encoder's differences. At a segment's start the filter's output is the measurement there. If
    one driver filters several channels, attach it to the group, ``"arm_velocity,pole_velocity"``.
    """

    id = "sensor_low_pass"
    parameters = (Parameter("time_constant", "s", 0.0, "time constant T"),)
    per_recording = ("time_constant",)
    spans = ("joint", "rate", "rates", "all")
    law = "ẏ = (x − y)/T"
    equivalence = (FIRST_ORDER_LAG,)
    excitation = "chirp"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform up to 30 ms."""
        return {"time_constant": dist.Uniform(0.0, 0.03)}

    def initial_memory(self, value: Tensor, reading: Tensor, start: Start) -> Any:
        """Returns the weights in the next measurement, and the filter's output and past values.

        There are weights for the true value, for the previous one and for the output. A position
        has two more for the curvature. The first of these applies to the next measurement only; it
        is zero, because the value before is unknown. The second one applies to all later ones.
        """
        time_constant = start.parameters["time_constant"]
        decay = remaining(time_constant, start.time_step)
        steps = time_constant / start.time_step
        trailing = steps * (1.0 - decay)
        shares = 1.0 - trailing, trailing - decay, decay
        bends = () if start.is_rate else (0.0 * steps, (steps + 0.5) * trailing - steps)
        shares, bends = (
            tuple(share.expand(value.shape) for share in group) for group in (shares, bends)
        )
        return shares, bends, (reading, value, value)

    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the filter's output, and the memory with the true value."""
        shares, bends, (output, last, previous) = memory
        reading = torch.addcmul(shares[0] * value, shares[1], last)
        reading = torch.addcmul(reading, shares[2], output)
        if bends:
            bend, bends = bends[0], (bends[1], bends[1])
            curvature = torch.add(value, last, alpha=-2.0) + previous
            reading = torch.addcmul(reading, bend, curvature)
        return reading, (shares, bends, (reading, value, last))


class EncoderBias(SensorEffect):
    """q + β."""

    id = "encoder_bias"
    parameters = (Parameter("offset", "{port}", 0.0, "offset β of the measurement"),)
    per_recording = ("offset",)
    spans = ("position",)
    law = "q + β"
    equivalence = (ANGLE_OFFSET,)
    excitation = "slow_ramp"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 1 % of the rated value."""
        return {"offset": dist.Normal(0.0, 0.01 * port.rated)}

    def suits(self, port: Port) -> bool:
        """Returns whether the channel is a position and not a rate."""
        return not port.unit.endswith("/s")

    def initial_value(self, reading: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Removes the offset."""
        return reading - parameters["offset"]

    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns q + β."""
        return value + parameters["offset"], memory


class EncoderScale(SensorEffect):
    """(1 + s) q."""

    id = "encoder_scale"
    parameters = (Parameter("error", "1", 0.0, "relative scale error s"),)
    spans = ("position",)
    law = "(1 + s) q"
    equivalence = (POSITION_SCALE,)
    excitation = "wide_range"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 1 %."""
        return {"error": dist.Normal(0.0, 0.01)}

    def suits(self, port: Port) -> bool:
        """Returns whether the channel is a position and not a rate."""
        return not port.unit.endswith("/s")

    def initial_value(self, reading: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Removes the scale error."""
        return reading / (1.0 + parameters["error"])

    def initial_rate(
        self, rate: Tensor, value: Tensor, parameters: Mapping[str, Tensor]
    ) -> Tensor:
        """Removes the scale error."""
        return rate / (1.0 + parameters["error"])

    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns (1 + s) q."""
        return (1.0 + parameters["error"]) * value, memory


class Quantisation(SensorEffect):
    """round(x/Δ) Δ: a measurement with resolution Δ, usually known from the device."""

    id = "quantisation"
    parameters = (Parameter("count", "{port}", 0.0, "resolution Δ"),)
    is_smooth = False
    is_noise = True
    law = "round(x/Δ) Δ"
    excitation = "slow_ramp"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Half-normal; 0.5 % of the rated value."""
        return {"count": dist.HalfNormal(0.005 * port.rated)}

    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the nearest multiple of Δ, or the value itself for Δ = 0."""
        count = parameters["count"]
        is_coarse = count > 0.0
        divisor = torch.where(is_coarse, count, torch.ones_like(count))
        # Rounding has no gradient; the gradient with respect to Δ is this integer.
        return torch.where(is_coarse, torch.round(value / divisor).detach() * count, value), memory
