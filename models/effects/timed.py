"""Forces that depend on the time."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects import ForceEffect

__all__ = ["TimedForceEffect"]


class TimedForceEffect(ForceEffect):
    """A force effect whose memory is the time in s since the rollout began.

    The time is that of the middle of the step, for which the force is constant.
    """

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> Tensor:
        """Returns the time half a step later."""
        return start.time + 0.5 * start.time_step

    def next_memory(
        self,
        position: Tensor,
        velocity: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Any,
        time_step: float,
    ) -> Tensor:
        """Returns the time one step later."""
        return memory + time_step
