"""Laws between a command and the actuator that gets it, as numbers of one simulation."""

import math
from collections import deque
from dataclasses import dataclass, field

__all__ = [
    "ActuatorGain",
    "ActuatorLag",
    "CommandLaw",
    "DeadZone",
    "GoalAccelerationLimit",
    "GoalResolution",
    "GoalSpeedLimit",
    "InputDelay",
    "IntegralAction",
    "Saturation",
    "ServoDeadBand",
    "ServoLaw",
    "SupplySag",
    "lengthened",
    "remaining",
]


@dataclass
class CommandLaw:
    """Changes a command once per control step.

    Attributes:
        actuator: Name or number of the actuator.
    """

    actuator: str | int

    def settle(self, command: float, step: float) -> float:
        """Sets the own state after a long time with a constant command; returns the output.

        Args:
            command: The command.
            step: Seconds per control step.
        """
        return self.act(command, step)[0]

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the output of a step: its mean, and its moment about the step's middle.

        The moment ∫ (t − h/2) u dt, in the command's unit times s², is zero for an output that is
        constant during the step.

        Args:
            command: The command.
            step: Seconds per control step.
        """
        raise NotImplementedError


def clip(value: float, bound: float) -> float:
    """Returns a value within ±bound."""
    return min(max(value, -bound), bound)


def remaining(time_constant: float, step: float) -> float:
    """Returns exp(−h/T), the share of a deviation that remains after a step."""
    return math.exp(-step / max(time_constant, step / 1000.0))


def lengthened(past: deque[float], length: int) -> deque[float]:
    """Returns past values, the newest first, with at least a length.

    The oldest value is repeated: before it, nothing had changed. Steps that are shorter than those
    for which the past was made need more of it.
    """
    missing = length - len(past)
    return deque([*past, *([past[-1]] * missing)], maxlen=length) if missing > 0 else past


@dataclass
class InputDelay(CommandLaw):
    """u(t − d) with a delay that need not be a whole number of steps."""

    delay: float
    past: deque[float] = field(default_factory=deque, init=False, repr=False)

    def settle(self, command: float, step: float) -> float:
        """Fills the past with the command."""
        length = math.floor(self.delay / step) + 2
        self.past = deque([command] * length, maxlen=length)
        return command

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the command of the delayed step."""
        whole = math.floor(self.delay / step)
        self.past = lengthened(self.past, whole + 2)
        self.past.appendleft(command)
        share = self.delay / step - whole
        later = self.past[whole]
        rise = share * (later - self.past[whole + 1])
        return later - rise, 0.5 * step * step * (1.0 - share) * rise


@dataclass
class ActuatorLag(CommandLaw):
    """A first-order lag with the time constant T."""

    time_constant: float
    output: float = field(default=0.0, init=False, repr=False)

    def settle(self, command: float, step: float) -> float:
        """Sets the output to the command."""
        self.output = command
        return command

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns mean and moment of the output."""
        t, half, decay = self.time_constant, 0.5 * step, remaining(self.time_constant, step)
        missing = self.output - command
        self.output = command + missing * decay
        moment = t * ((t - half) - (t + half) * decay)
        return command + missing * (t / step) * (1.0 - decay), missing * moment


@dataclass
class ActuatorGain(CommandLaw):
    """(1 + ε) u."""

    error: float

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the output."""
        return (1.0 + self.error) * command, 0.0


@dataclass
class SupplySag(CommandLaw):
    """(1 − a |u|) u."""

    sag: float

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the output."""
        return (1.0 - self.sag * abs(command)) * command, 0.0


@dataclass
class Saturation(CommandLaw):
    """clip(u, ±u_max)."""

    limit: float

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the output."""
        return clip(command, self.limit), 0.0


@dataclass
class DeadZone(CommandLaw):
    """sign(u) max(|u| − δ, 0)."""

    width: float

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the output."""
        return command - clip(command, self.width), 0.0


@dataclass
class GoalResolution(CommandLaw):
    """Δ round(u/Δ)."""

    step: float

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns the goal."""
        return (self.step * round(command / self.step) if self.step > 0.0 else command), 0.0


@dataclass
class GoalSpeedLimit(CommandLaw):
    """A goal that approaches the command at a limited speed."""

    limit: float
    goal: float = field(default=0.0, init=False, repr=False)

    def settle(self, command: float, step: float) -> float:
        """Sets the goal to the command."""
        self.goal = command
        return command

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns mean and moment of the goal."""
        distance, furthest = command - self.goal, self.limit * step
        share = min(abs(distance) / furthest, 1.0) if furthest > 0.0 else 1.0
        travel = clip(distance, furthest)
        self.goal += travel
        moment = share * travel * step**2 * (0.25 - share / 6.0)
        return self.goal - 0.5 * share * travel, moment


@dataclass
class GoalAccelerationLimit(CommandLaw):
    """A goal that approaches the command at a limited acceleration, and can stop there."""

    limit: float
    goal: float = field(default=0.0, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def settle(self, command: float, step: float) -> float:
        """Sets the goal to the command, at rest."""
        self.goal, self.speed = command, 0.0
        return command

    def act(self, command: float, step: float) -> tuple[float, float]:
        """Returns mean and moment of the goal."""
        h, distance, change = step, command - self.goal, self.limit * step
        furthest = 0.5 * change * h
        if abs(distance) <= furthest and abs(self.speed) <= change:
            # It arrives, and brakes over the share of the step that it needs.
            share = abs(distance) / furthest if furthest > 0.0 else 0.0
            self.goal, self.speed = command, 0.0
            late, travel = share * distance / 3.0, distance
        else:
            side = math.copysign(1.0, distance) if distance else 0.0
            ahead = max(2.0 * abs(distance) / h - side * self.speed, 0.0)
            wanted = side * 2.0 * ahead / (1.0 + math.sqrt(1.0 + 4.0 * ahead / change))
            reached = max(min(wanted, self.speed + change), self.speed - change)
            share, travel = 1.0, 0.5 * h * (self.speed + reached)
            late = h * (self.speed + 2.0 * reached) / 6.0
            self.goal, self.speed = self.goal + travel, reached
        return self.goal - late, share * travel * h**2 * (2.0 - share) / 12.0


@dataclass
class ServoLaw:
    """Changes the error of a position servo in every engine step.

    Attributes:
        actuator: Name or number of the servo.
    """

    actuator: str | int

    def reset(self) -> None:
        """Sets the own state as a rollout begins."""

    def act(self, error: float, mean: float, step: float) -> tuple[float, float]:
        """Returns the error on which the servo acts as a step begins, and its mean.

        Args:
            error: Goal minus position at the start of an engine step.
            mean: Its mean during the step.
            step: Seconds per engine step.
        """
        raise NotImplementedError


@dataclass
class ServoDeadBand(ServoLaw):
    """sign(e) max(|e| − δ, 0)."""

    width: float

    def act(self, error: float, mean: float, step: float) -> tuple[float, float]:
        """Returns the error on which the servo acts as a step begins, and its mean."""
        return error - clip(error, self.width), mean - clip(mean, self.width)


@dataclass
class IntegralAction(ServoLaw):
    """e + w, ẇ = r e, |w| ≤ w_max."""

    rate: float
    limit: float
    integral: float = field(default=0.0, init=False, repr=False)

    def reset(self) -> None:
        """Sets the integral part to zero."""
        self.integral = 0.0

    def act(self, error: float, mean: float, step: float) -> tuple[float, float]:
        """Returns the error on which the servo acts as a step begins, and its mean."""
        middle = clip(self.integral + 0.5 * step * self.rate * error, self.limit)
        self.integral = clip(self.integral + step * self.rate * mean, self.limit)
        return error + middle, mean + middle
