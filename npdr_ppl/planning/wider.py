"""Which limit keeps the causes from being told apart: the chance with each limit twice as wide."""

import math
import time
from dataclasses import dataclass, replace

from npdr_ppl.errors import DataError
from npdr_ppl.language.channels import Channel
from npdr_ppl.language.simulator import Simulator
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
        chance: The chance with as many rollouts as a plan may have. The search is short, so a
            longer one can find more.
    """

    limit: str
    chance: float


def chances_with_wider_limits(
    known: Known,
    limits: Limits,
    number: int,
    *,
    seed: int,
    time_limit: float,
    least_time: float = 0.0,
) -> tuple[Wider, ...]:
    """Returns the chance with each kind of limit twice as wide, the greatest first.

    Args:
        known: The causes, at the time step of the limits.
        limits: The limits of the plan.
        number: Number of rollouts that a plan may have.
        seed: Seed of the searches.
        time_limit: Seconds after which no further kind is searched.
        least_time: Seconds that a kind takes at least, as the final figures of the plan did. No
            kind is searched if less time is left.
    """
    begin, result = time.monotonic(), []
    wider = wider_limits(limits, known.causes[0].simulator)
    for name, allowed in wider.items():
        began = time.monotonic()
        left = time_limit - (began - begin)
        if left <= least_time:
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
        chosen = rollouts_that_separate(
            known, shown, explored.every, least=number, most=number, num_distinct=number
        )
        result.append(Wider(name, chance_of(known, shown, chosen).right))
        least_time = time.monotonic() - began
    return tuple(sorted(result, key=lambda one: one.chance, reverse=True))


def wider_limits(limits: Limits, simulator: Simulator) -> dict[str, Limits]:
    """Returns the limits with each kind twice as wide, without those that cannot be wider.

    Commands and positions do not go beyond what the model declares: a motor has no more.

    Args:
        limits: The limits.
        simulator: The simulator, with the ranges of its actions and sensors.
    """
    nyquist = 0.5 / limits.time_step
    declared = {c.name: c for c in (*simulator.actions, *simulator.sensors)}
    result = {
        "commands": replace(
            limits,
            actions={n: _more_command(a, declared[n]) for n, a in limits.actions.items()},
        ),
        "channels": replace(
            limits,
            channels={n: _more_motion(c, declared[n]) for n, c in limits.channels.items()},
        ),
        "bandwidth": replace(limits, bandwidth=min(2.0 * limits.bandwidth, nyquist)),
    }
    return {name: allowed for name, allowed in result.items() if allowed != limits}


def _more_command(action: ActionLimits, declared: Channel) -> ActionLimits:
    """Returns a command's limits twice as far from its value at rest, and twice the rates."""
    low = max(2.0 * action.min - action.start, declared.lower)
    high = min(2.0 * action.max - action.start, declared.upper)
    return replace(
        action,
        # A recording may have gone beyond what the model declares.
        min=min(low, action.min),
        max=max(high, action.max),
        max_rate=2.0 * action.max_rate,
        max_acceleration=2.0 * action.max_acceleration,
    )


def _more_motion(channel: ChannelLimits, declared: Channel) -> ChannelLimits:
    """Returns a channel's limits about the same middle, twice as wide, and twice the rates."""
    if math.isfinite(channel.max - channel.min):
        half = 0.5 * (channel.max - channel.min)
        low = max(channel.min - half, declared.lower)
        high = min(channel.max + half, declared.upper)
        channel = replace(channel, min=min(low, channel.min), max=max(high, channel.max))
    return replace(
        channel,
        max_rate=2.0 * channel.max_rate,
        max_acceleration=2.0 * channel.max_acceleration,
    )
