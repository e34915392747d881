"""Open-loop policies: recorded sequences and excitations."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.policies.base import Policy, PolicyParameter

__all__ = ["Chirp", "Playback", "Sinusoid", "Strike"]

# In s. Shorter durations are raised to this value, because a search may propose zero or less.
_SHORTEST = 1e-3


class Playback(Policy):
    """Commands a recorded sequence, independent of the observations.

    Args:
        commands: Sequence, shape ``(K, A)``; the last command is held afterwards.
        actions: Names of the A action channels.
        time_step: Seconds per command.
    """

    observations = ()

    def __init__(self, commands: Tensor, actions: tuple[str, ...], time_step: float) -> None:
        super().__init__()
        if commands.ndim != 2 or commands.shape[-1] != len(actions):
            raise ShapeError(
                f"A recorded sequence for {', '.join(actions)} has the shape (steps, "
                f"{len(actions)}), but got {commands.shape=}."
            )
        self.actions = actions
        self.time_step = time_step
        self.commands = commands

    def act(
        self, observation: tuple[Tensor, ...], time: Tensor | float, memory: Any, constants: Any
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the command of the current step."""
        time = torch.as_tensor(time, device=self.commands.device)
        step = torch.round(time / self.time_step).long().clamp(max=len(self.commands) - 1)
        # Not indexed by brackets: a compiled loop would need the number.
        row = self.commands.index_select(0, step.reshape(1))
        return row[0].unbind(-1), memory


class _OneChannel(Policy):
    """A function of time on one channel.

    Args:
        action: Name of the channel.
        parameters: See the subclass.
    """

    observations = ()

    def __init__(self, action: str, parameters: Tensor | None = None) -> None:
        super().__init__(parameters)
        self.actions = (action,)


class Sinusoid(_OneChannel):
    """A sin(2π f t + φ) on one channel.

    Args:
        action: Name of the channel.
        parameters: Amplitude A in the channel's unit, frequency f in Hz and phase φ in rad, shape
            ``(..., 3)``.
    """

    parameter_info = (
        PolicyParameter("amplitude", 1.0, 0.0),
        PolicyParameter("frequency", 1.0, 0.0),
        PolicyParameter("phase", 0.0, -math.pi, math.pi),
    )

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: dict[str, Tensor],
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the command of the current time."""
        k = constants
        angle = 2.0 * math.pi * k["frequency"] * time + k["phase"]
        return (k["amplitude"] * torch.sin(angle),), memory


class Chirp(_OneChannel):
    """A sine whose frequency changes linearly from f₀ to f₁ in a given time, then stays constant.

    A sin(2π (f₀ t + (f₁ − f₀) t²/(2 T))) + c with amplitude A, duration T and offset c.

    Args:
        action: Name of the channel.
        parameters: A and c in the channel's unit, f₀ and f₁ in Hz, T in s, shape ``(..., 5)``.
    """

    parameter_info = (
        PolicyParameter("amplitude", 1.0, 0.0),
        PolicyParameter("first_frequency", 0.1, 0.0),
        PolicyParameter("last_frequency", 5.0, 0.0),
        PolicyParameter("duration", 5.0, _SHORTEST),
        PolicyParameter("offset", 0.0),
    )

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: dict[str, Tensor],
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the command of the current time."""
        k = constants
        first, last = k["first_frequency"], k["last_frequency"]
        duration = k["duration"].clamp_min(_SHORTEST)
        swept = torch.clamp(torch.as_tensor(time).to(duration), max=duration)
        rest = time - swept
        turns = first * swept + (last - first) * swept * swept / (2.0 * duration) + last * rest
        return (k["amplitude"] * torch.sin(2.0 * math.pi * turns) + k["offset"],), memory


class StrikeConstants(NamedTuple):
    """Parameters of :class:`Strike`."""

    duration: Tensor
    end: tuple[Tensor, ...]


class Strike(Policy):
    """A point-to-point motion: position commands from a start to an end, where they are held.

    q(t) = q₀ + s(t/T) (q₁ − q₀) with s(x) = x, or with the minimum-jerk profile, which starts and
    ends at rest,

        s(x) = 10 x³ − 15 x⁴ + 6 x⁵,   x ≤ 1.

    Args:
        actions: Names of the A position channels.
        start: Positions q₀ at the start in the channels' units, A numbers.
        end: Default of the positions q₁ at the end, A numbers.
        duration: Default of the duration T, in s.
        profile: Profile s of the motion.
        limits: Least and greatest end of each channel.
        parameters: T in s, then q₁, shape ``(..., 1 + A)``.

    Reference: Flash and Hogan, The coordination of arm movements, J. Neurosci. 1985, equation 4
    (minimum jerk).
    """

    observations = ()

    def __init__(
        self,
        actions: tuple[str, ...],
        start: Sequence[float],
        end: Sequence[float],
        *,
        duration: float = 0.5,
        profile: Literal["linear", "minimum-jerk"] = "linear",
        limits: Sequence[tuple[float, float]] | None = None,
        parameters: Tensor | None = None,
    ) -> None:
        limits = ((-math.inf, math.inf),) * len(actions) if limits is None else limits
        if not len(actions) == len(start) == len(end) == len(limits):
            raise ShapeError(
                f"A strike of {', '.join(actions)} needs {len(actions)} numbers of each kind, but "
                f"got {len(start)} starts, {len(end)} ends and {len(limits)} limits."
            )
        if profile not in ("linear", "minimum-jerk"):
            raise ModelError(f"profile is 'linear' or 'minimum-jerk', got {profile!r}.")
        self.actions = actions
        self.start = tuple(float(value) for value in start)
        self.profile = profile
        self.parameter_info = (
            PolicyParameter("duration", duration, _SHORTEST),
            *(
                PolicyParameter(f"{action}.end", float(value), lower, upper)
                for action, value, (lower, upper) in zip(actions, end, limits, strict=True)
            ),
        )
        super().__init__(parameters)

    def constants(self, domain: Mapping[str, Tensor]) -> StrikeConstants:
        """Returns the parameters."""
        duration, *end = self.parameters.unbind(-1)
        return StrikeConstants(duration.clamp_min(_SHORTEST), tuple(end))

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: StrikeConstants,
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the positions of the current time."""
        x = (time / constants.duration).clamp(0.0, 1.0)
        if self.profile == "minimum-jerk":
            x = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        # Written so that the end is reached exactly.
        commands = tuple(
            (1.0 - x) * first + x * last
            for first, last in zip(self.start, constants.end, strict=True)
        )
        return commands, memory
