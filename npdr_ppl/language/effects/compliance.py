"""Effects of a carrier that yields about a joint's axis."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

from torch import Tensor

from npdr_ppl.language.channels import Port, PortKind
from npdr_ppl.language.effects.effect import Effect

__all__ = ["Carrier", "ComplianceEffect"]


class Carrier(NamedTuple):
    """The spring, the damper and the inertia between a joint and the body that carries it.

    Attributes:
        stiffness: Of the spring, k, {force}/{coordinate}.
        time_constant: √(I/k) with the inertia or mass I of the carrier alone, s.
        damping_ratio: Damping ratio of the carrier alone.
    """

    stiffness: Tensor
    time_constant: Tensor
    damping_ratio: Tensor


class ComplianceEffect(Effect):
    """An effect that adds a second joint on the axis of a joint, whose sensor does not see it.

    The engine moves the second joint together with all others, so that the whole mechanism reacts
    to it. At the start of a segment its spring balances the forces on it.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("force",)

    def suits(self, port: Port) -> bool:
        """Returns whether a drive acts on the joint."""
        return port.is_driven

    @abstractmethod
    def carrier(self, parameters: Mapping[str, Tensor]) -> Carrier:
        """Returns the carrier.

        At zero strength it must be so stiff, and therefore so heavy, that nothing moves it.

        Args:
            parameters: The effect's parameters by short name.
        """
