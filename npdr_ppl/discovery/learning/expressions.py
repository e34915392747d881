"""Expressions of laws, and the functions that they call.

An expression is Python source. It is evaluated along the recorded motion to choose terms, and it
is copied into the file of the learned effect together with the functions that it calls, so both
are the same law.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache
from types import CodeType
from typing import Any

import torch
from torch import Tensor

from npdr_ppl.language.effects import Commands

__all__ = [
    "FUNCTIONS",
    "bent",
    "bent_unevenly",
    "delayed",
    "evaluated",
    "hat",
    "lagged",
    "mean_lagged",
    "mean_ringing",
    "relaxed",
    "ringing",
]


def hat(x: Tensor, left: float, centre: float, right: float) -> Tensor:
    """Returns the hat function of a linear spline; it is one beyond the first and last knots."""
    rising = torch.ones_like(x) if left == centre else (x - left) / (centre - left)
    falling = torch.ones_like(x) if right == centre else (right - x) / (right - centre)
    return torch.minimum(rising, falling).clamp(0.0, 1.0)


def bent(bend: Tensor, moved: Tensor, width: Tensor) -> Tensor:
    """Returns the bend of bristles, within ±1, after a displacement; b' = (v − |v| b)/w."""
    side = moved.sign()
    return side + (bend - side) * torch.exp(-moved.abs() / width)


def bent_unevenly(bend: Tensor, moved: Tensor, width: Tensor, asymmetry: Tensor) -> Tensor:
    """Returns the bend of bristles that unload along another path than they load.

    b' = (v − |v| (1 − β + β sign(v b)) b)/w with the asymmetry β, at most 0.49. Bristles that are
    bent against the motion first unload at the rate 1 − 2 β, then load at the rate 1.
    """
    side, way = moved.sign(), moved.abs() / width
    rate = 1.0 - 2.0 * asymmetry.clamp(0.0, 0.49)
    along = side * bend
    opposed = along.clamp_max(0.0)
    unloading = torch.log1p(-rate * opposed) / rate
    unloaded = 1.0 / rate + (opposed - 1.0 / rate) * torch.exp(-rate * way)
    loaded = 1.0 + (along.clamp_min(0.0) - 1.0) * torch.exp(-(way - unloading).clamp_min(0.0))
    return torch.where(moved == 0.0, bend, side * torch.where(way < unloading, unloaded, loaded))


def relaxed(stretch: Tensor, moved: Tensor, seconds: float, time_constant: Tensor) -> Tensor:
    """Returns the stretch of a spring in series with a damper; r' = v − r/T."""
    ratio = seconds / time_constant
    left = torch.exp(-ratio)
    return stretch * left + moved * (1.0 - left) / ratio


def lagged(output: Tensor, u: Tensor, seconds: float, time_constant: Tensor) -> Tensor:
    """Returns the output of a first-order lag after a step; z' = (u − z)/T."""
    return u + (output - u) * torch.exp(-seconds / time_constant)


def mean_lagged(output: Tensor, u: Tensor, seconds: float, time_constant: Tensor) -> Tensor:
    """Returns the mean output of a first-order lag during a step."""
    ratio = seconds / time_constant
    return u + (output - u) * (1.0 - torch.exp(-ratio)) / ratio


def ringing(
    ring: tuple[Tensor, Tensor], u: Tensor, seconds: float, time_constant: Tensor, damping: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns a resonance's output and its rate after a step; T² z'' + 2 ζ T z' = u − z.

    The damping ratio ζ is below 0.99: the solution is that of a resonance that oscillates.
    """
    output, rate = ring
    damping = damping.clamp(0.0, 0.99)
    fading = damping / time_constant
    frequency = torch.sqrt(1.0 - damping * damping) / time_constant
    left = torch.exp(-fading * seconds)
    cos, sin = torch.cos(frequency * seconds), torch.sin(frequency * seconds)
    gap = output - u
    other = (rate + fading * gap) / frequency
    return (
        u + left * (gap * cos + other * sin),
        left * (rate * cos - (fading * other + frequency * gap) * sin),
    )


def mean_ringing(
    ring: tuple[Tensor, Tensor], u: Tensor, seconds: float, time_constant: Tensor, damping: Tensor
) -> Tensor:
    """Returns a resonance's mean output during a step."""
    output, rate = ringing(ring, u, seconds, time_constant, damping)
    faster = time_constant * time_constant * (rate - ring[1])
    further = 2.0 * damping.clamp(0.0, 0.99) * time_constant * (output - ring[0])
    return u - (faster + further) / seconds


def delayed(commands: Commands, delay: Tensor, seconds: float) -> Tensor:
    """Returns the mean command of a step, a delay ago; commands are constant within a step."""
    steps = (delay / seconds).clamp_min(0.0).expand(commands.now().shape)
    whole = torch.floor(steps.detach())
    later, earlier = commands.delayed(whole.long()), commands.delayed(whole.long() + 1)
    return later + (steps - whole) * (earlier - later)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    function.__name__: function
    for function in (
        hat,
        bent,
        bent_unevenly,
        relaxed,
        lagged,
        mean_lagged,
        ringing,
        mean_ringing,
        delayed,
    )
}
"""The functions by name."""


@lru_cache(maxsize=4096)
def _compiled(expression: str) -> CodeType:
    return compile(expression, "<term>", "eval")


def evaluated(expression: str, known: Mapping[str, Any]) -> Any:
    """Returns the value of an expression of this package.

    Args:
        expression: The expression.
        known: Values of its variables and constants.
    """
    space = {"torch": torch, **FUNCTIONS, "__builtins__": {}}
    return eval(_compiled(expression), space, dict(known))
