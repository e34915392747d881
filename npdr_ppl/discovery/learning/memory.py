"""States with which a law remembers: hysteresis and relaxation at joints, delays and lags.

A state at a segment's start comes from the motion or the commands before it, as far as they were
recorded.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.discovery.learning.expressions import evaluated
from npdr_ppl.discovery.learning.recorded_motion import PortMotion

__all__ = [
    "DELAY",
    "HYSTERESIS",
    "LAG",
    "RELAXATION",
    "RESONANCE",
    "UNEVEN_HYSTERESIS",
    "CommandMemory",
    "Delay",
    "Memory",
    "MotionMemory",
]

TIME_CONSTANTS = 7.0
"""Time, in time constants, after which a lag has forgotten all but exp(−7), a thousandth."""


@dataclass(frozen=True)
class Memory(ABC):
    """A state on which a law depends.

    Attributes:
        symbol: Its name in expressions.
        letter: Its letter in formulas.
        equation: Its differential equation, with the letters of the constants.
        about: What it is.
    """

    symbol: str
    letter: str
    equation: str
    about: str

    @abstractmethod
    def along(self, motion: PortMotion, constants: Mapping[str, float]) -> Tensor:
        """Returns the state's mean over each step of the recorded motion, ``(S, K)``.

        Args:
            motion: The motion at the port.
            constants: Constants of its equation, by name.
        """


@dataclass(frozen=True)
class MotionMemory(Memory):
    """A state of a force at a joint, which the joint's displacements change.

    Attributes:
        now: Expression of the state within a step, from that at the step's start and the
            displacement ``moved`` since then.
        later: Expression of the state after so many ``seconds`` with this displacement.
    """

    now: str
    later: str

    def along(self, motion: PortMotion, constants: Mapping[str, float]) -> Tensor:
        """Returns the state in the middle of each step; it is zero where the past begins."""
        known: dict[str, Any] = _tensors(constants)
        state = torch.zeros_like(motion.values["t"][:, 0])
        for moved in motion.past.unbind(1):
            known |= {self.symbol: state, "moved": moved, "seconds": motion.interval}
            state = evaluated(self.later, known)
        q, v = motion.values["q"], motion.values["v"]
        middle = q + 0.5 * motion.time_step * v
        before, found = q[:, 0], []
        known["seconds"] = motion.time_step
        for place in middle.unbind(1):
            known |= {self.symbol: state, "moved": place - before}
            found.append(evaluated(self.now, known))
            state, before = evaluated(self.later, known), place
        return torch.stack(found, dim=1)


@dataclass(frozen=True)
class CommandMemory(Memory):
    """A state that commands change.

    Attributes:
        now: Expression of the state's mean over a step, from that at the step's start.
        later: Expression of the state after ``seconds`` with a command.
        settled: Expression of the state after a long time with one ``command``.
        is_resonant: Whether it oscillates.
    """

    now: str
    later: str
    settled: str = "command"
    is_resonant: bool = False

    def fades_in(self, constants: Mapping[str, float]) -> float:
        """Returns the time in s after which it has forgotten."""
        slowness = 1.0 / constants["damping"] if self.is_resonant else 1.0
        return TIME_CONSTANTS * slowness * constants["time_constant"]

    def along(self, motion: PortMotion, constants: Mapping[str, float]) -> Tensor:
        """Returns the state's mean over each step; it is settled where the past begins."""
        known: dict[str, Any] = {**_tensors(constants), "seconds": motion.time_step}
        most = math.ceil(self.fades_in(constants) / motion.time_step)
        past = motion.past[:, max(0, motion.past.shape[1] - most) :]
        u = torch.cat((past, motion.values["u"]), dim=1)
        state, found = evaluated(self.settled, {"command": u[:, 0]}), []
        for step, command in enumerate(u.unbind(1), -past.shape[1]):
            known |= {self.symbol: state, "u": command}
            if step >= 0:
                found.append(evaluated(self.now, known))
            state = evaluated(self.later, known)
        return torch.stack(found, dim=1)


@dataclass(frozen=True)
class Delay(Memory):
    """The command a while ago."""

    def along(self, motion: PortMotion, constants: Mapping[str, float]) -> Tensor:
        """Returns the delayed command's mean over each step."""
        steps = constants["delay"] / motion.time_step
        whole, num = math.floor(steps), motion.values["u"].shape[1]
        oldest = motion.past[:, :1] if motion.past.shape[1] else motion.values["u"][:, :1]
        before = oldest.expand(-1, max(0, whole + 1 - motion.past.shape[1]))
        u = torch.cat((before, motion.past, motion.values["u"]), dim=1)
        first = u.shape[1] - num - whole
        later, earlier = u[:, first : first + num], u[:, first - 1 : first - 1 + num]
        return later + (steps - whole) * (earlier - later)


def _tensors(constants: Mapping[str, float]) -> dict[str, Any]:
    return {name: torch.tensor(x, dtype=torch.float64) for name, x in constants.items()}


HYSTERESIS = MotionMemory(
    "bend",
    "b",
    "b' = (v − |v| b)/w",
    "the bend of bristles, within ±1",
    "bent(bend, moved, width)",
    "bent(bend, moved, width)",
)
"""Dahl's model."""

UNEVEN_HYSTERESIS = MotionMemory(
    "bend",
    "b",
    "b' = (v − |v| (1 − β + β sign(v b)) b)/w",
    "the bend of bristles, within ±1",
    "bent_unevenly(bend, moved, width, asymmetry)",
    "bent_unevenly(bend, moved, width, asymmetry)",
)
"""The model of Bouc and Wen with the exponent one."""

RELAXATION = MotionMemory(
    "stretch",
    "r",
    "r' = v − r/T",
    "the stretch of a spring in series with a damper",
    "stretch + moved",
    "relaxed(stretch, moved, seconds, time_constant)",
)
"""Maxwell's model of a viscoelastic force."""

LAG = CommandMemory(
    "output",
    "z",
    "z' = (u − z)/T",
    "the command after a first-order lag",
    "mean_lagged(output, u, seconds, time_constant)",
    "lagged(output, u, seconds, time_constant)",
)

RESONANCE = CommandMemory(
    "ring",
    "z",
    "T² z'' + 2 ζ T z' = u − z",
    "the command after a resonance",
    "mean_ringing(ring, u, seconds, time_constant, damping)",
    "ringing(ring, u, seconds, time_constant, damping)",
    "(command, torch.zeros_like(command))",
    is_resonant=True,
)

DELAY = Delay("late", "u(t − d)", "", "the command a time d ago")
