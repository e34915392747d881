"""Effects between the true value of a channel and its measurement."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from npdr_ppl.language.channels import PortKind
from npdr_ppl.language.effect_context import SensorSpan, Start
from npdr_ppl.language.effects.effect import Effect

__all__ = ["BentSensorEffect", "SensorEffect"]


class SensorEffect(Effect):
    """An effect between the true value of a channel and its measurement.

    Attributes:
        needs_past: Whether its initial memory needs :attr:`Start.changes`.
        spans: The channels that one device can affect with the same parameters.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("sensor",)
    needs_past: ClassVar[bool] = False
    spans: ClassVar[tuple[SensorSpan, ...]] = ("position", "rate", "positions", "rates")

    @property
    def may_cover_several(self) -> bool:
        """Whether one device may affect several channels: always."""
        return True

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns the number of past true values that the memory holds."""
        return 0

    def initial_memory(self, value: Tensor, reading: Tensor, start: Start) -> Any:
        """Returns the effect's own state at a segment's start; ``None`` if it has none.

        Args:
            value: True value of the channel at the start.
            reading: Measurement at the start.
            start: Other known data at the start.
        """
        return None

    def initial_value(self, reading: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the true value at a segment's start for the measurement there.

        By default it is the measurement itself. Effects with an offset or a wrong scale must
        remove it, otherwise re-synchronised segments would start from the wrong state.
        """
        return reading

    def initial_rate(
        self, rate: Tensor, value: Tensor, parameters: Mapping[str, Tensor]
    ) -> Tensor:
        """Returns the true rate of change for a rate derived from successive measurements.

        By default it is the rate itself. Effects with a wrong scale of measurements or time stamps
        must remove it.

        Args:
            rate: The derived rate at the segment's start.
            value: True value of the channel there.
            parameters: The effect's parameters by short name.
        """
        return rate

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor | None:
        """Returns by how many seconds measurements lead the true values; ``None`` for zero.

        A delay is negative. The initial state of a segment is moved forward in time by the delay
        of its measurement, unless the robot was held until its rollout began.

        Args:
            parameters: The effect's parameters by short name.
            time: Seconds since the rollout began.
        """
        return None

    @abstractmethod
    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the measurement after a step, and the next memory."""


class BentSensorEffect(SensorEffect):
    """A sensor effect that depends on how the true value moves within a step."""

    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the same for a value that moved along a straight line."""
        return self.read_bent(value, torch.zeros_like(value), parameters, memory, time_step)

    @abstractmethod
    def read_bent(
        self,
        value: Tensor,
        bend: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Any,
        time_step: float,
    ) -> tuple[Tensor, Any]:
        """Returns the measurement after a step along a parabola, and the next memory.

        Args:
            value: True value after the step.
            bend: b, with which the true value went from x₀ to x₁ along
                (1 − s) x₀ + s x₁ + s (1 − s) b, s from 0 to 1.
            parameters: The effect's parameters by short name.
            memory: The effect's own state.
            time_step: Seconds per step.
        """
