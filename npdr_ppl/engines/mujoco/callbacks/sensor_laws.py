"""Laws between a true value and its measurement, as numbers of one simulation."""

import math
from collections import deque
from dataclasses import dataclass, field

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
    """

    channel: str

    def reset(self, value: float, step: float, is_rate: bool) -> float:
        """Sets the own state at the start, at which the robot rests; returns the measurement.

        Args:
            value: True value.
            step: Seconds per control step.
            is_rate: Whether it is a velocity, which has kinks between steps.
        """
        return self.read(value, 0.0, step)

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the measurement after a step.

        Args:
            value: True value.
            time: Seconds since the start.
            step: Seconds per control step.
        """
        raise NotImplementedError


@dataclass
class EncoderBias(SensorLaw):
    """q + β."""

    offset: float

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the measurement."""
        return value + self.offset


@dataclass
class EncoderScale(SensorLaw):
    """(1 + s) q."""

    error: float

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the measurement."""
        return (1.0 + self.error) * value


@dataclass
class Quantisation(SensorLaw):
    """round(x/Δ) Δ."""

    count: float

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the measurement."""
        return round(value / self.count) * self.count if self.count > 0.0 else value


@dataclass
class SensorLowPass(SensorLaw):
    """ẏ = (x − y)/T, exact for lines between samples; for positions for parabolas."""

    time_constant: float
    output: float = field(default=0.0, init=False, repr=False)
    past: tuple[float, float] = field(default=(0.0, 0.0), init=False, repr=False)
    is_rate: bool = field(default=False, init=False, repr=False)
    is_first: bool = field(default=True, init=False, repr=False)

    def reset(self, value: float, step: float, is_rate: bool) -> float:
        """Sets the output to the value."""
        self.output, self.past = value, (value, value)
        self.is_rate, self.is_first = is_rate, True
        return value

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the filter's output."""
        decay, steps = remaining(self.time_constant, step), self.time_constant / step
        trailing = steps * (1.0 - decay)
        last, previous = self.past
        output = (1.0 - trailing) * value + (trailing - decay) * last + decay * self.output
        if not (self.is_rate or self.is_first):
            bend = (steps + 0.5) * trailing - steps
            output += bend * (value - 2.0 * last + previous)
        self.output, self.past, self.is_first = output, (value, last), False
        return output


@dataclass
class SensorDelay(SensorLaw):
    """x(t − d), interpolated on a line for velocities and on a parabola for positions."""

    delay: float
    past: deque[float] = field(default_factory=deque, init=False, repr=False)
    is_rate: bool = field(default=False, init=False, repr=False)

    def reset(self, value: float, step: float, is_rate: bool) -> float:
        """Fills the past with the value."""
        length = math.floor(self.delay / step) + 3
        self.past, self.is_rate = deque([value] * length, maxlen=length), is_rate
        return value

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the value a time d earlier."""
        steps = self.delay / step
        self.past = lengthened(self.past, math.floor(steps) + 3)
        self.past.appendleft(value)
        return sum(self.weight(steps - j) * earlier for j, earlier in enumerate(self.past))

    def weight(self, age: float) -> float:
        """Returns the weight of a value in the value ``age`` steps before it."""
        if self.is_rate:
            return max(1.0 - abs(age), 0.0)
        if not -2.0 < age < 1.0:
            return 0.0
        if age >= 0.0:
            return (1.0 - age) * (1.0 - 0.5 * age)
        return (1.0 + age) * (1.0 - age) if age >= -1.0 else 0.5 * (2.0 + age) * (1.0 + age)


@dataclass
class ClockSkew(SensorLaw):
    """x(t (1 + κ)): measurements timed by a clock with another rate."""

    skew: float
    past: tuple[float, float] = field(default=(0.0, 0.0), init=False, repr=False)
    is_rate: bool = field(default=False, init=False, repr=False)

    def reset(self, value: float, step: float, is_rate: bool) -> float:
        """Fills the past with the value."""
        self.past, self.is_rate = (value, value), is_rate
        return value

    def read(self, value: float, time: float, step: float) -> float:
        """Returns the value κ t ahead."""
        last, previous = self.past
        lead = self.skew * time / step
        bend = 0.0 if self.is_rate else value - 2.0 * last + previous
        self.past = value, last
        return value + lead * (value - last + 0.5 * (1.0 + lead) * bend)
