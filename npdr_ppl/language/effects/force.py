"""Effects at a joint: generalised forces and dry friction."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from npdr_ppl.language.channels import PortKind
from npdr_ppl.language.effect_context import Joint, Start
from npdr_ppl.language.effects.effect import Effect

__all__ = ["ForceEffect", "LinearForceEffect"]


class ForceEffect(Effect):
    """An effect at a joint: a generalised force, dry friction, or both.

    Attributes:
        needs_joint: Whether :meth:`begin_step` is called, which costs the engine two evaluations
            of the accelerations per step.
        needs_only_drive: Whether :meth:`begin_step` reads nothing of the joint's dynamics but
            :attr:`Joint.drive`. Engines may then leave acceleration and inverse inertia NaN.
        needs_past: Whether its initial memory needs :attr:`Start.displacements`.
        standard_law: ``"damping"`` with the parameter ``damping``, ``"dry friction"`` with
            ``magnitude``, or ``"spring"`` with ``stiffness`` and ``rest``, if the law is one that
            engines have themselves; else empty. A subclass with another law makes it empty.
        acts_on_floating: Whether it can attach to an axis of a floating body; see
            ``Port.is_floating``. The position is NaN there. Such a law has no dry friction and
            does not need the joint.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("force",)
    needs_joint: ClassVar[bool] = False
    needs_only_drive: ClassVar[bool] = False
    needs_past: ClassVar[bool] = False
    standard_law: ClassVar[str] = ""
    acts_on_floating: ClassVar[bool] = False

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> Any:
        """Returns the effect's own state at a segment's start; ``None`` if it has none."""
        return None

    def begin_step(
        self, joint: Joint, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> Any:
        """Returns the memory with the data of the joint that the step's forces need.

        It is called before :meth:`force` and :meth:`dry_friction` if ``needs_joint`` is true. A
        stiff law can solve for its mean force over the step here, keep it in the memory and return
        it from :meth:`force`.
        """
        return memory

    def force(
        self,
        position: Tensor,
        velocity: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Any,
    ) -> Tensor | None:
        """Returns a generalised force that is smooth in the state, or ``None``.

        It is evaluated in every stage of the integrator.
        """
        return None

    def moment(self, parameters: Mapping[str, Tensor], memory: Any) -> Tensor | None:
        """Returns the first moment of the force within a step, or ``None`` if it is constant.

        ∫ (t − h/2) f dt about the middle of a step of length h, in the force's unit times s², for
        an effect with ``needs_joint``; see :class:`~npdr_ppl.language.effects.action.Uneven`.
        Engines that hold forces constant for a step ignore it.
        """
        return None

    def dry_friction(
        self,
        position: Tensor,
        velocity: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Any,
    ) -> Tensor | None:
        """Returns the greatest magnitude of dry friction, or ``None``.

        The engine applies this force against the motion, and at rest up to this force to keep the
        joint at rest (stiction). This is Coulomb's set-valued law, solved within a step instead of
        smoothed.
        """
        return None

    def next_memory(
        self,
        position: Tensor,
        velocity: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Any,
        time_step: float,
    ) -> Any:
        """Returns the effect's own state one step later."""
        return memory


class LinearForceEffect(ForceEffect):
    """A force that is linear in base parameters, f = Σ_i φ_i(q, q̇) b_i, while the joint moves.

    By default the base parameters b are the effect's own parameters. Dry friction is linear in
    its magnitudes while the joint moves. At rest it equals the force that holds the joint, and its
    columns are zero.
    """

    @abstractmethod
    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns φ_i, the force per unit of each base parameter, shaped like the position."""

    def to_base(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Returns the base parameters b for the effect's parameters (short names)."""
        return tuple(parameters[parameter.name] for parameter in self.parameters)

    def from_base(self, base: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """Returns the parameters by short name; the inverse of :meth:`to_base`."""
        return {p.name: value for p, value in zip(self.parameters, base, strict=True)}
