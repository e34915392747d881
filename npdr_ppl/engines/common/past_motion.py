"""Motion before segments, from which forces that remember compute their state at the start."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.inputs import Inputs

__all__ = ["PastMotion", "past_motion"]

# How far back forces remember: as far as commands; and in how many intervals, which bounds the
# memory. At 50 ms per interval, the turning points of a motion of 2 Hz are missed by 5 % at most.
_PAST_SECONDS = 5.0
_MOST_INTERVALS = 100


class PastMotion(NamedTuple):
    """Motion of the joints before the segments.

    Attributes:
        displacements: How far each joint moved in each interval, oldest first, ``(N,)`` each;
            empty where that is unknown.
        interval: Length of the intervals, in s.
    """

    displacements: tuple[tuple[Tensor, ...], ...] = ()
    interval: float = 0.0

    def put_into(self, start: Start, joint: int) -> Start:
        """Returns the data of a segment's start with the motion of a joint before it."""
        if not self.displacements:
            return start
        moved = self.displacements[joint]
        return start._replace(displacements=moved, interval=self.interval)

    def part(self, first: int, last: int) -> "PastMotion":
        """Returns the motion of some of the N simulations."""
        return PastMotion(
            tuple(tuple(x[first:last] for x in joint) for joint in self.displacements),
            self.interval,
        )


def past_motion(
    inputs: Inputs, channels: Sequence[str | None], shape: torch.Size, dtype: torch.dtype
) -> PastMotion:
    """Returns how the joints moved before the segments, as recorded.

    Args:
        inputs: The segments.
        channels: Name of the channel that measures the position of each joint; ``None`` if none
            does, or if no effect needs it.
        shape: Shape of the batch and the segments, of numel N.
        dtype: Floating type of the simulation.
    """
    if not any(channels) or inputs.recorded_readings is None:
        return PastMotion()
    most = round(_PAST_SECONDS / inputs.time_step)
    # The length of the rollouts: a segment's past does not depend on what it is simulated with.
    stride = max(1, -(-min(most, inputs.recorded_readings.shape[-2]) // _MOST_INTERVALS))
    num_steps = min(most, int(inputs.start.max()))
    steps = stride * torch.arange(-(-num_steps // stride), -1, -1)
    found = []
    for name in channels:
        positions = None if name is None else inputs.earlier(name, steps)
        moved = () if positions is None else positions.to(dtype).diff(dim=0).unbind(0)
        found.append(tuple(step.expand(shape).reshape(-1) for step in moved))
    return PastMotion(tuple(found), stride * inputs.time_step)
