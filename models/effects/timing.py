"""Measurements that are late, or whose time stamps come from a wrong clock."""

import math
from collections.abc import Mapping

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import BentSensorEffect
from npdr_ppl.models.effects.equivalence import LATENCY
from npdr_ppl.models.effects.references import LJUNG_1999

__all__ = ["ClockSkew", "SensorDelay"]

_Past = tuple[tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]
"""Weights of values, weights of bends, past values and past bends."""


def _on_line(age: Tensor) -> Tensor:
    """Returns the weight of a value in the value ``age`` steps before it, on a line."""
    return (1.0 - age.abs()).clamp_min(0.0)


def _of_bend(age: Tensor) -> Tensor:
    """Returns the weight of a step's bend in the value ``age`` steps before the step's end."""
    return (age * (1.0 - age)).clamp_min(0.0)


class SensorDelay(BentSensorEffect):
    """y(t) = x(t − d) with a delay d that need not be a whole number of steps.

    Between steps a value follows its bend; see :meth:`BentSensorEffect.read_bent`. Attach it to
    all channels that share the delay.

    The measurement at a segment's start is the state d earlier. The segment's initial state is
    computed from it by the simulator without its effects, under the commands of that time. The
    measurements until d has passed are those on the way. A robot at rest at a rollout's first
    sample counts as held there before.
    """

    id = "sensor_delay"
    parameters = (Parameter("delay", "s", 0.0, "delay d"),)
    is_smooth = False
    needs_past = True
    spans = ("joint", "rates", "all")
    law = "y(t − d)"
    equivalence = (LATENCY,)
    excitation = "chirp"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Uniform up to 30 ms."""
        return {"delay": dist.Uniform(0.0, 0.03)}

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns the number of past values that the longest delay needs, and one."""
        return math.floor(float(parameters["delay"].detach().max()) / time_step) + 2

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns −d."""
        return -parameters["delay"]

    def initial_memory(self, value: Tensor, reading: Tensor, start: Start) -> _Past:
        """Returns the weights of x_k, x_{k−1}, … and of the bends, and both, latest first."""
        steps, num = start.parameters["delay"] / start.time_step, start.history
        weights = tuple(_on_line(steps - j).expand(value.shape) for j in range(num + 1))
        of_bends = tuple(_of_bend(steps - j).expand(value.shape) for j in range(num))
        bends = (*start.bends, *(torch.zeros_like(value) for _ in range(num)))
        return weights, of_bends, (value, *start.past(value)[:-1]), bends[: num - 1]

    def read_bent(
        self,
        value: Tensor,
        bend: Tensor,
        parameters: Mapping[str, Tensor],
        memory: _Past,
        time_step: float,
    ) -> tuple[Tensor, _Past]:
        """Returns the value a time d earlier."""
        weights, of_bends, past, bends = memory
        past, bends = (value, *past), (bend, *bends)
        reading = torch.zeros_like(value)
        for weight, part in zip((*weights, *of_bends), (*past, *bends), strict=True):
            reading = torch.addcmul(reading, weight, part)
        return reading, (weights, of_bends, past[:-1], bends[:-1])


class ClockSkew(BentSensorEffect):
    """y(t) = x(t (1 + κ)): measurements timed by a clock with another rate than the commands'.

    κ t is small. A value therefore follows from that of the last step and from its bend; see
    :meth:`BentSensorEffect.read_bent`. Both clocks agree when a rollout begins; measurements at a
    segment's start are κ t ahead.
    """

    id = "clock_skew"
    port_kinds = ("clock",)
    parameters = (Parameter("skew", "1", 0.0, "relative skew κ"),)
    law = "t (1 + κ)"
    excitation = "long_run"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 300 ppm."""
        return {"skew": dist.Normal(0.0, 3e-4)}

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns κ t."""
        return parameters["skew"] * time

    def initial_rate(
        self, rate: Tensor, value: Tensor, parameters: Mapping[str, Tensor]
    ) -> Tensor:
        """Removes the time's scale."""
        return rate / (1.0 + parameters["skew"])

    def initial_memory(
        self, value: Tensor, reading: Tensor, start: Start
    ) -> tuple[Tensor, Tensor]:
        """Returns the time and the present value."""
        return start.time, value

    def read_bent(
        self,
        value: Tensor,
        bend: Tensor,
        parameters: Mapping[str, Tensor],
        memory: tuple[Tensor, Tensor],
        time_step: float,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Returns the value κ t ahead."""
        before, last = memory
        time = before + time_step
        lead = parameters["skew"] * time / time_step
        reading = value + lead * (value - last - (1.0 + lead) * bend)
        return reading, (time, value)
