"""Laws between a true value and its measurement, as numbers of one simulation."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

from npdr_ppl.engines.mujoco.callbacks.command_laws import lengthened, remaining

__all__ = [
    "ClockSkew",
    "EncoderBias",
    "EncoderScale",
    "Quantisation",
    "SensorDelay",
    "SensorLaw",
    "SensorLowPass",
]


@dataclass
class SensorLaw:
    """Changes the measurement of a channel once per control step.

    Attributes:
        channel: Name of the channel.
        takes_bend: Whether it uses how the value moved within a step.
    """

    takes_bend: ClassVar[bool] = False

    channel: str

    def reset(self, value: float, step: float) -> float:
        """Sets the own state at the start, at which the robot rests; returns the measurement.

        Args:
            value: True value.
            step: Seconds per control step.
        """
        return self.read(value, 0.0, 0.0, step)

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the measurement after a step.

        Args:
            value: True value.
            bend: b, with which the true value went from x₀ to x₁ along
                (1 − s) x₀ + s x₁ + s (1 − s) b, s from 0 to 1.
            time: Seconds since the start.
            step: Seconds per control step.
        """
        raise NotImplementedError


@dataclass
class EncoderBias(SensorLaw):
    """q + β."""

    offset: float

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the measurement."""
        return value + self.offset


@dataclass
class EncoderScale(SensorLaw):
    """(1 + s) q."""

    error: float

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the measurement."""
        return (1.0 + self.error) * value


@dataclass
class Quantisation(SensorLaw):
    """round(x/Δ) Δ."""

    count: float

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the measurement."""
        return round(value / self.count) * self.count if self.count > 0.0 else value


@dataclass
class SensorLowPass(SensorLaw):
    """ẏ = (x − y)/T, exact for a value that follows its bend."""

    takes_bend: ClassVar[bool] = True
    time_constant: float
    output: float = field(default=0.0, init=False, repr=False)
    last: float = field(default=0.0, init=False, repr=False)

    def reset(self, value: float, step: float) -> float:
        """Sets the output to the value."""
        self.output = self.last = value
        return value

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the filter's output."""
        decay, steps = remaining(self.time_constant, step), self.time_constant / step
        trailing = steps * (1.0 - decay)
        output = (1.0 - trailing) * value + (trailing - decay) * self.last + decay * self.output
        output += 2.0 * (steps - (steps + 0.5) * trailing) * bend
        self.output, self.last = output, value
        return output


@dataclass
class SensorDelay(SensorLaw):
    """x(t − d), along the bends of the steps."""

    takes_bend: ClassVar[bool] = True
    delay: float
    past: deque[float] = field(default_factory=deque, init=False, repr=False)
    bends: deque[float] = field(default_factory=deque, init=False, repr=False)

    def reset(self, value: float, step: float) -> float:
        """Fills the past with the value."""
        length = math.floor(self.delay / step) + 3
        self.past = deque([value] * length, maxlen=length)
        self.bends = deque([0.0] * length, maxlen=length)
        return value

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the value a time d earlier."""
        steps = self.delay / step
        length = math.floor(steps) + 3
        self.past, self.bends = lengthened(self.past, length), lengthened(self.bends, length)
        self.past.appendleft(value)
        self.bends.appendleft(bend)
        age, k = steps % 1.0, math.floor(steps)
        line = (1.0 - age) * self.past[k] + age * self.past[k + 1]
        return line + age * (1.0 - age) * self.bends[k]


@dataclass
class ClockSkew(SensorLaw):
    """x(t (1 + κ)): measurements timed by a clock with another rate."""

    takes_bend: ClassVar[bool] = True
    skew: float
    last: float = field(default=0.0, init=False, repr=False)

    def reset(self, value: float, step: float) -> float:
        """Keeps the value."""
        self.last = value
        return value

    def read(self, value: float, bend: float, time: float, step: float) -> float:
        """Returns the value κ t ahead."""
        lead = self.skew * time / step
        reading = value + lead * (value - self.last - (1.0 + lead) * bend)
        self.last = value
        return reading
