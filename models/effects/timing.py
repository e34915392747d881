"""Measurements that are late, or whose time stamps come from a wrong clock."""

import math
from collections.abc import Mapping

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.language.channels import Parameter, Port
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import SensorEffect
from npdr_ppl.models.effects.equivalence import LATENCY
from npdr_ppl.models.effects.references import LJUNG_1999

__all__ = ["ClockSkew", "SensorDelay"]


def _on_line(age: Tensor) -> Tensor:
    """Returns the weight of a value in the value ``age`` steps before it, on a line."""
    return (1.0 - age.abs()).clamp_min(0.0)


def _on_parabola(age: Tensor) -> Tensor:
    """Returns the same on the parabola through the two adjacent values and the one before them."""
    share = torch.where(age >= 0.0, (1.0 - age) * (1.0 - 0.5 * age), (1.0 + age) * (1.0 - age))
    share = torch.where(age >= -1.0, share, 0.5 * (2.0 + age) * (1.0 + age))
    return torch.where((age > -2.0) & (age < 1.0), share, 0.0)


class SensorDelay(SensorEffect):
    """y(t) = x(t − d) with a delay d that need not be a whole number of steps.

    Between steps of length h a velocity is interpolated linearly, because it has kinks where
    commands change. A position is interpolated by the parabola through the two adjacent values and
    the one before. Attach it to all channels that share the delay.

    The measurement at a segment's start is the state d earlier. The segment's initial state is
    computed from it by the simulator without its effects, under the commands of that time. The
    measurements until d has passed are computed in the same way, backwards. A robot at rest at a
    rollout's first sample counts as held there before.
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
        """Returns the number of steps in the longest delay, and one for the curvature."""
        return math.floor(float(parameters["delay"].detach().max()) / time_step) + 2

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns −d."""
        return -parameters["delay"]

    def initial_memory(
        self, value: Tensor, reading: Tensor, start: Start
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Returns the weights of x_k, x_{k−1}, …, and the past values, latest first."""
        steps = start.parameters["delay"] / start.time_step
        weight = _on_line if start.is_rate else _on_parabola
        weights = tuple(weight(steps - j).expand(value.shape) for j in range(start.history + 1))
        return weights, (value, *start.past(value)[:-1])

    def read(
        self,
        value: Tensor,
        parameters: Mapping[str, Tensor],
        memory: tuple[tuple[Tensor, ...], tuple[Tensor, ...]],
        time_step: float,
    ) -> tuple[Tensor, tuple[tuple[Tensor, ...], tuple[Tensor, ...]]]:
        """Returns the value a time d earlier."""
        weights, past = memory
        reading = weights[0] * value
        for weight, earlier in zip(weights[1:], past, strict=True):
            reading = torch.addcmul(reading, weight, earlier)
        return reading, (weights, (value, *past[:-1]))


class ClockSkew(SensorEffect):
    """y(t) = x(t (1 + κ)): measurements timed by a clock with another rate than the commands'.

    κ t is small. A position therefore follows from the parabola through its last three values. A
    velocity follows from the line through two, because it has kinks where commands change. Both
    clocks agree when a rollout begins; measurements at a segment's start are κ t ahead.
    """

    id = "clock_skew"
    port_kinds = ("clock",)
    parameters = (Parameter("skew", "1", 0.0, "relative skew κ"),)
    needs_past = True
    law = "t (1 + κ)"
    excitation = "long_run"
    reference = LJUNG_1999

    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Normal; 300 ppm."""
        return {"skew": dist.Normal(0.0, 3e-4)}

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns 2."""
        return 2

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns κ t."""
        return parameters["skew"] * time

    def initial_rate(
        self, rate: Tensor, value: Tensor, parameters: Mapping[str, Tensor]
    ) -> Tensor:
        """Removes the time's scale."""
        return rate / (1.0 + parameters["skew"])

    def initial_memory(self, value: Tensor, reading: Tensor, start: Start) -> tuple[Tensor, ...]:
        """Returns the time, the curvature's weight, the current value and the one before it."""
        smooth = torch.full_like(value, 0.0 if start.is_rate else 1.0)
        return start.time, smooth, value, start.past(value)[0]

    def read(
        self,
        value: Tensor,
        parameters: Mapping[str, Tensor],
        memory: tuple[Tensor, ...],
        time_step: float,
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Returns the value κ t ahead."""
        before, smooth, last, previous = memory
        time = before + time_step
        lead = parameters["skew"] * time / time_step
        curvature = smooth * (value - 2.0 * last + previous)
        ahead = lead * (value - last + 0.5 * (1.0 + lead) * curvature)
        return value + ahead, (time, smooth, value, last)
