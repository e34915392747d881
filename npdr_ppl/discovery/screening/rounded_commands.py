"""The step to which a servo rounds its goals, found from the recording."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from npdr_ppl.discovery.screening.latent_force import Responses
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.screening.pulse_changes import PulseChanges
from npdr_ppl.discovery.screening.settings import GENERIC_LAWS

__all__ = ["strongest_rounding"]

_MOST_ROUNDINGS, _MOST_VALUES = 64, 4_000_000
"""Greatest numbers of roundings that are tried together, and of rounded commands at once."""


def strongest_rounding(
    projection: Projection, found: Responses, command: str, port: str, largest: float
) -> float | None:
    """Returns the step that explains most if a command is rounded to its multiples.

    The error of the rounded command acts as a force at the joint of its servo. Two steps round
    the greatest command u alike if its numbers of steps, u/Δ, differ by much less than one. So
    these differ by a quarter between steps that are tried. But a slightly different step rounds
    some commands to the next multiple, so that the misfit has local minima. Therefore many steps
    about the strongest are tried, too. The first ones round the command at the beginning of each
    pulse, these the commands of all steps. The result is ``None`` if the command is constant, or
    if no step explains anything.

    Args:
        projection: The fitted model.
        found: The responses to pulses.
        command: The command.
        port: The port of the force at the joint.
        largest: The largest step.
    """
    u = found.channels[command]
    pulses = PulseChanges(projection, found.by_port[port])

    def strongest(numbers: Tensor, errors: Callable[[Tensor], Tensor], most: int) -> float | None:
        """Returns that of some numbers of steps per unit, ``(n,)``."""
        gains = []
        for part in numbers.split(most):
            scores = pulses.scores(errors(part))
            is_told = scores.absorbed < 1.0 - 1e-6
            # The force has the sign of the error.
            gain = scores.score.clamp_min(0.0).square() / scores.information.diagonal()
            gains.append(torch.where(is_told, gain, 0.0))
        gain, index = torch.cat(gains).max(0)
        return float(numbers[index]) if gain > 0.0 else None

    if not bool((u != u[0, 0]).any()):
        return None
    spacing = 0.25 / max(float(u.abs().max()), largest)
    more = spacing * torch.arange(GENERIC_LAWS.num_roundings, dtype=torch.float64)
    first = strongest(1.0 / largest + more, partial(_errors_of_rounding, u), _MOST_ROUNDINGS)
    if first is None:
        return None
    about = torch.linspace(-1.0, 1.0, GENERIC_LAWS.num_finer_roundings, dtype=torch.float64)

    inputs = projection.hypothesis.segments.inputs
    whole = inputs.actions[..., inputs.action_names.index(command)].double()
    # Steps from each pulse's beginning to the next one's, or to the end.
    begins = ((found.time[0] - found.time[0, 0]) / inputs.time_step).round().long()
    lengths = begins.diff(append=begins.new_tensor([inputs.num_steps])).tolist()

    def mean_errors(numbers: Tensor) -> Tensor:
        parts = _errors_of_rounding(whole, numbers).split(lengths, dim=1)
        return torch.stack([part.mean(1) for part in parts], dim=1)

    together = max(1, min(_MOST_ROUNDINGS, _MOST_VALUES // whole.numel()))
    finer = (first + spacing * about).clamp_min(1.0 / largest)
    return 1.0 / (strongest(finer, mean_errors, together) or first)


def _errors_of_rounding(commands: Tensor, numbers: Tensor) -> Tensor:
    """Returns the errors of commands, ``(S, K)``, rounded to steps, ``(S, K, n)``.

    Args:
        commands: The commands.
        numbers: Numbers of steps per unit, ``(n,)``.
    """
    return (commands[..., None] * numbers).round() / numbers - commands[..., None]
