"""Which limit keeps the causes from being told apart: the chance with each limit twice as wide."""

import math
import time
from dataclasses import dataclass, replace

from npdr_ppl.errors import DataError
from npdr_ppl.planning.causes import Known
from npdr_ppl.planning.exploration import explore
from npdr_ppl.planning.limits import ActionLimits, ChannelLimits, Limits
from npdr_ppl.planning.selection import chance_of, rollouts_that_separate
from npdr_ppl.planning.settings import PLANNING

__all__ = ["Wider", "chances_with_wider_limits", "wider_limits"]


@dataclass(frozen=True)
class Wider:
    """The chance of naming the right cause if one kind of limit is twice as wide.

    Attributes:
        limit: ``"commands"``, ``"bandwidth"`` or ``"channels"``.
        chance: The chance with as many rollouts as the plan has. The search is short, so a longer
            one can find more.
    """

    limit: str
    chance: float


def chances_with_wider_limits(
    known: Known, limits: Limits, number: int, *, seed: int, time_limit: float
) -> tuple[Wider, ...]:
    """Returns the chance with each kind of limit twice as wide, the greatest first.

    Args:
        known: The causes, at the time step of the limits.
        limits: The limits of the plan.
        number: Number of rollouts.
        seed: Seed of the searches.
        time_limit: Seconds after which no further kind is searched.
    """
    begin, result = time.monotonic(), []
    wider = wider_limits(limits)
    for name, allowed in wider.items():
        left = time_limit - (time.monotonic() - begin)
        if left <= 0.0:
            break
        try:
            explored = explore(
                known,
                allowed,
                rounds=PLANNING.first_batches,
                time_limit=left / len(wider),
                seed=seed,
            )
            shown = explored.judge.shown(explored.played)
        except DataError:
            continue  # no motion with these limits can be simulated
        chosen = rollouts_that_separate(known, shown, explored.every, least=number, most=number)
        result.append(Wider(name, chance_of(known, shown, chosen).right))
    return tuple(sorted(result, key=lambda one: one.chance, reverse=True))


def wider_limits(limits: Limits) -> dict[str, Limits]:
    """Returns the limits with each kind twice as wide, without those that have no end."""
    nyquist = 0.5 / limits.time_step
    result = {
        "commands": replace(
            limits, actions={name: _more_command(a) for name, a in limits.actions.items()}
        ),
        "channels": replace(
            limits, channels={name: _more_motion(c) for name, c in limits.channels.items()}
        ),
        "bandwidth": replace(limits, bandwidth=min(2.0 * limits.bandwidth, nyquist)),
    }
    return {name: allowed for name, allowed in result.items() if allowed != limits}


def _more_command(action: ActionLimits) -> ActionLimits:
    """Returns a command's limits twice as far from its value at rest, and twice the rates."""
    return replace(
        action,
        min=2.0 * action.min - action.start,
        max=2.0 * action.max - action.start,
        max_rate=2.0 * action.max_rate,
        max_acceleration=2.0 * action.max_acceleration,
    )


def _more_motion(channel: ChannelLimits) -> ChannelLimits:
    """Returns a channel's limits about the same middle, twice as wide, and twice the rates."""
    if math.isfinite(channel.max - channel.min):
        half = 0.5 * (channel.max - channel.min)
        channel = replace(channel, min=channel.min - half, max=channel.max + half)
    return replace(
        channel,
        max_rate=2.0 * channel.max_rate,
        max_acceleration=2.0 * channel.max_acceleration,
    )
