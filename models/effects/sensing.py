"""What happens between a true value and its reading."""

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
    """ẏ = (x − y)/T: a filtered reading, e.g. a velocity derived from an encoder.

    Exact for values that change along a line between samples, so that the reading trails by T at
    any sampling rate, as that of a driver does which filters the encoder's differences. The
    filter's output at a segment's start is what was read there. Attach it to a group of channels,
    ``"arm_velocity,pole_velocity"``, where one driver filters them all.
    """

    id = "sensor_low_pass"
    parameters = (Parameter("time_constant", "s", 0.0, "time constant T"),)
    spans = ("joint", "rate", "rates", "all")
    law = "ẏ = (x − y)/T"
    equivalence = (FIRST_ORDER_LAG,)
    excitation = "chirp"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform up to 30 ms."""
        return {"time_constant": dist.Uniform(0.0, 0.03)}

    def initial_memory(
        self, value: Tensor, reading: Tensor, start: Start
    ) -> tuple[Tensor, Tensor]:
        """Returns the filter's output and the true value."""
        return reading, value

    def read(
        self,
        value: Tensor,
        parameters: Mapping[str, Tensor],
        memory: tuple[Tensor, Tensor],
        time_step: float,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Returns the filter's output, and with the true value its memory."""
        output, last = memory
        time_constant = parameters["time_constant"]
        decay = remaining(time_constant, time_step)
        trailing = time_constant / time_step * (1.0 - decay)
        output = value + trailing * (last - value) + decay * (output - last)
        return output, (output, value)


class EncoderBias(SensorEffect):
    """q + β."""

    id = "encoder_bias"
    parameters = (Parameter("offset", "{port}", 0.0, "offset β of the reading"),)
    spans = ("position",)
    law = "q + β"
    equivalence = (ANGLE_OFFSET,)
    excitation = "slow_ramp"
    reference = MUJOCO

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 1 % of the rated value."""
        return {"offset": dist.Normal(0.0, 0.01 * port.rated)}

    def suits(self, port: Port) -> bool:
        """Returns whether a position is read, and no rate."""
        return not port.unit.endswith("/s")

    def initial_value(self, reading: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Takes the offset out."""
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
        """Returns whether a position is read, and no rate."""
        return not port.unit.endswith("/s")

    def initial_value(self, reading: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Takes the scale error out."""
        return reading / (1.0 + parameters["error"])

    def initial_rate(self, rate: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Takes the scale error out."""
        return rate / (1.0 + parameters["error"])

    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns (1 + s) q."""
        return (1.0 + parameters["error"]) * value, memory


class Quantisation(SensorEffect):
    """round(x/Δ) Δ: a reading in whole counts of Δ, usually known from the device."""

    id = "quantisation"
    parameters = (Parameter("count", "{port}", 0.0, "size of a count Δ"),)
    is_smooth = False
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
        # The number of counts has no gradient; that of the reading in Δ is this number.
        return torch.where(is_coarse, torch.round(value / divisor).detach() * count, value), memory
