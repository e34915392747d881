"""Effects of a carrier that yields about a joint's axis."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

from torch import Tensor

from npdr_ppl.language.channels import Port, PortKind
from npdr_ppl.language.effects.effect import Effect

__all__ = ["Carrier", "ComplianceEffect"]


class Carrier(NamedTuple):
    """What lies between a joint and a fixed place, as far as it turns about the joint's axis.

    Attributes:
        stiffness: Of its spring, {force}/{coordinate}.
        damping: Of its damper, {force} s/{coordinate}.
        inertia: Its own inertia or mass, without what the joint moves.
    """

    stiffness: Tensor
    damping: Tensor
    inertia: Tensor


class ComplianceEffect(Effect):
    """An effect by which a joint has a second one on its axis, which its sensor does not see.

    The engine moves the second joint together with all others, so that the whole mechanism reacts
    to it. As a segment begins it is where the spring balances the forces on it.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("force",)

    def suits(self, port: Port) -> bool:
        """Returns whether a drive acts on the joint."""
        return port.is_driven

    @abstractmethod
    def carrier(self, parameters: Mapping[str, Tensor]) -> Carrier:
        """Returns the carrier.

        At zero strength it must be so stiff and heavy that nothing moves it.

        Args:
            parameters: The effect's parameters by short name.
        """
