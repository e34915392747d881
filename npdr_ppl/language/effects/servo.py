"""Effects inside a position servo."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from npdr_ppl.language.channels import Port, PortKind
from npdr_ppl.language.effects.effect import Effect

__all__ = ["ServoEffect"]


class ServoEffect(Effect):
    """An effect inside a position servo, which acts on another error than goal minus position.

    Its own state at the start of a segment follows from the goals and positions that were recorded
    since the rollout began.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("servo",)

    def suits(self, port: Port) -> bool:
        """Returns whether the servo follows its joint's position."""
        return port.follows_position

    def initial_memory(self, error: Tensor) -> Tensor | None:
        """Returns the effect's own state, ``(N,)``, as a rollout begins; ``None`` if it has none.

        Args:
            error: Zeros, ``(N,)``: before a rollout, the servo was at its goal.
        """
        return None

    @abstractmethod
    def act(
        self, error: Tensor, parameters: Mapping[str, Tensor], memory: Tensor | None
    ) -> Tensor:
        """Returns the error on which the servo acts; evaluated in every step of the engine.

        Args:
            error: Goal minus position at the start of the step, ``(N,)``.
            parameters: The effect's parameters by short name.
            memory: The effect's own state in the middle of the step.
        """

    def next_memory(
        self,
        error: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Tensor | None,
        time_step: float,
    ) -> Tensor | None:
        """Returns the effect's own state after ``time_step`` seconds with an error.

        It must be a law in continuous time, and leave ``memory`` unchanged: in each step of the
        engine it is called twice from the same state, for half of the step and for all of it.

        Args:
            error: Mean of goal minus position during this time, ``(N,)``.
            parameters: The effect's parameters by short name.
            memory: The effect's own state before.
            time_step: Duration in s.
        """
        return memory
