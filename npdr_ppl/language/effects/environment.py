"""Effects on quantities that are constant in a segment: the environment and domain parameters."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from npdr_ppl.language.channels import PortKind
from npdr_ppl.language.effects.effect import Effect

__all__ = ["EnvironmentEffect", "LoadEffect", "ParameterEffect"]


class EnvironmentEffect(Effect):
    """An effect that changes a quantity of the environment before the simulation starts."""

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("environment",)

    @abstractmethod
    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the changed quantity.

        Examples are the gravity vector (x, y, z) in m/s², and the
        :class:`~npdr_ppl.language.effect_context.Servo` at a servo's port.
        """


class LoadEffect(EnvironmentEffect):
    """A point mass at a port that is the mass of a body, at a place of its own.

    :meth:`environment` returns the mass together with the body's.
    """

    @abstractmethod
    def place(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Returns its place (x, y, z) in m from the body's centre of mass, along its axes."""


class ParameterEffect(Effect):
    """An effect that changes a domain parameter from segment to segment.

    Every domain parameter is a port. The parameter is constant within a segment.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("parameter",)

    @abstractmethod
    def change(self, value: Tensor, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns the domain parameter during a segment.

        Args:
            value: The domain parameter.
            parameters: The effect's parameters by short name.
            time: Seconds from the start of the rollout to the middle of the segment.
        """
