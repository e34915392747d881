"""Effects between a true value and its measurement."""

from collections.abc import Mapping
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import BentSensorEffect, SensorEffect
from npdr_ppl.models.effects.equivalence import ANGLE_OFFSET, FIRST_ORDER_LAG, POSITION_SCALE
from npdr_ppl.models.effects.lag import remaining
from npdr_ppl.models.effects.references import LJUNG_1999, MUJOCO

__all__ = ["EncoderBias", "EncoderScale", "Quantisation", "SensorLowPass"]


class SensorLowPass(BentSensorEffect):
    """ẏ = (x − y)/T: a filtered measurement, e.g. a velocity derived from an encoder.

    Exact for a value that follows its bend; see :meth:`BentSensorEffect.read_bent`. The
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
        """Returns the weights in the next measurement, the filter's output and the true value.

        There are weights for the true value, for the one before it, for the output, and for the
        bend.
        """
        time_constant = start.parameters["time_constant"]
        decay = remaining(time_constant, start.time_step)
        steps = time_constant / start.time_step
        trailing = steps * (1.0 - decay)
        of_bend = 2.0 * (steps - (steps + 0.5) * trailing)
        weights = 1.0 - trailing, trailing - decay, decay, of_bend
        return tuple(weight.expand(value.shape) for weight in weights), (reading, value)

    def read_bent(
        self,
        value: Tensor,
        bend: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Any,
        time_step: float,
    ) -> tuple[Tensor, Any]:
        """Returns the filter's output, and the memory with the true value."""
        weights, (output, last) = memory
        reading = weights[0] * value
        for weight, part in zip(weights[1:], (last, output, bend), strict=True):
            reading = torch.addcmul(reading, weight, part)
        return reading, (weights, (reading, value))


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
