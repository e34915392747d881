"""Open-loop policies: recorded sequences and excitations."""

import math
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.errors import ShapeError
from npdr_ppl.policies.base import Policy, PolicyParameter

__all__ = ["Chirp", "Playback", "Sinusoid"]


class Playback(Policy):
    """Commands a recorded sequence, whatever it observes.

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
        """Returns the command of the present step."""
        step = torch.round(torch.as_tensor(time) / self.time_step).long()
        row = self.commands[step.clamp(max=len(self.commands) - 1)]
        return row.unbind(-1), memory


class Sinusoid(Policy):
    """A sin(2π f t + φ) on one channel.

    Args:
        action: Name of the channel.
        parameters: Amplitude A in the channel's unit, frequency f in Hz and phase φ in rad, shape
            ``(..., 3)``.
    """

    observations = ()
    parameter_info = (
        PolicyParameter("amplitude", 1.0, 0.0),
        PolicyParameter("frequency", 1.0, 0.0),
        PolicyParameter("phase", 0.0, -math.pi, math.pi),
    )

    def __init__(self, action: str, parameters: Tensor | None = None) -> None:
        super().__init__(parameters)
        self.actions = (action,)

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: dict[str, Tensor],
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the command of the present time."""
        k = constants
        angle = 2.0 * math.pi * k["frequency"] * time + k["phase"]
        return (k["amplitude"] * torch.sin(angle),), memory


class Chirp(Policy):
    """A sine whose frequency runs linearly from f₀ to f₁ in a given time, then stays.

    A sin(2π (f₀ t + (f₁ − f₀) t²/(2 T))) + c with amplitude A, duration T and offset c.

    Args:
        action: Name of the channel.
        parameters: A and c in the channel's unit, f₀ and f₁ in Hz, T in s, shape ``(..., 5)``.
    """

    observations = ()
    parameter_info = (
        PolicyParameter("amplitude", 1.0, 0.0),
        PolicyParameter("first_frequency", 0.1, 0.0),
        PolicyParameter("last_frequency", 5.0, 0.0),
        PolicyParameter("duration", 5.0, 0.0),
        PolicyParameter("offset", 0.0),
    )

    def __init__(self, action: str, parameters: Tensor | None = None) -> None:
        super().__init__(parameters)
        self.actions = (action,)

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Any,
        constants: dict[str, Tensor],
    ) -> tuple[tuple[Tensor, ...], Any]:
        """Returns the command of the present time."""
        k = constants
        first, last, duration = k["first_frequency"], k["last_frequency"], k["duration"]
        swept = torch.clamp(torch.as_tensor(time).to(duration), max=duration)
        rest = time - swept
        turns = first * swept + (last - first) * swept * swept / (2.0 * duration) + last * rest
        return (k["amplitude"] * torch.sin(2.0 * math.pi * turns) + k["offset"],), memory
