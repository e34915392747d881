"""Effects on a command before it reaches the dynamics."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from torch import Tensor

from npdr_ppl.language.channels import PortKind
from npdr_ppl.language.effect_context import Start
from npdr_ppl.language.effects.effect import Effect

__all__ = ["ActionEffect", "Commands", "Uneven"]


class Commands(ABC):
    """The present and past commands, for an action effect."""

    @abstractmethod
    def now(self) -> Tensor:
        """Returns the present command."""

    @abstractmethod
    def delayed(self, steps: Tensor) -> Tensor:
        """Returns the command of ``steps`` (integers ≥ 0) steps ago, per batch element."""


class Uneven(NamedTuple):
    """A command that changes within a step.

    The mean determines the change of velocities over the step; the moment adds to the change of
    positions. Engines that hold a command constant for a step use only the mean.

    Attributes:
        mean: Its mean, in its unit.
        moment: Its first moment ∫ (t − h/2) u dt about the middle of a step of length h, in its
            unit times s².
    """

    mean: Tensor
    moment: Tensor


class ActionEffect(Effect):
    """An effect on a command before it reaches the dynamics.

    Attributes:
        may_be_shared: Whether all commands may have it with the same parameters, because one
            device or bus sends them.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("action", "servo")
    may_be_shared: ClassVar[bool] = False

    @property
    def may_cover_several(self) -> bool:
        """Whether several commands may have it; see ``may_be_shared``."""
        return self.may_be_shared

    def initial_memory(self, command: Tensor, start: Start) -> Any:
        """Returns the effect's own state after a long time with a constant ``command``.

        ``None`` if it has no state.
        """
        return None

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns the number of past commands that :meth:`act` may request."""
        return 0

    @property
    def memory_time(self) -> float:
        """For how many seconds past commands influence the effect's own state.

        At the start of a segment, the state is computed from commands of that time, and of those
        that :meth:`history` counts, as far as they are included in the inputs.
        """
        has_state = type(self).initial_memory is not ActionEffect.initial_memory
        return math.inf if has_state else 0.0

    def peaks(self, commands: Tensor, time_step: float) -> dict[str, float]:
        """Returns the greatest values in a recording of what its parameters limit, by parameter.

        Searches begin below them. For limits that are not in the result, they try several values
        of the prior.

        Args:
            commands: Recorded commands, time last.
            time_step: Seconds per step.
        """
        return {}

    @abstractmethod
    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor | Uneven, Any]:
        """Returns the command that reaches the dynamics in this step, and the next memory."""
