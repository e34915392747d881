"""Effects: physical causes a simulator may miss, declared once and attached to ports.

An effect is data plus one law. The law is written against plain tensors that carry the batch
dimensions, so any engine that can hand over velocities, commands or readings can apply it.
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import torch
from pyro.distributions import Uniform
from torch import Tensor
from torch.distributions import Distribution

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter, Port, PortKind
from npdr_ppl.language.effect_context import (
    EquivalenceClass,
    Excitation,
    Joint,
    SensorSpan,
    Start,
)

__all__ = [
    "ActionEffect",
    "Commands",
    "Effect",
    "EnvironmentEffect",
    "ForceEffect",
    "LinearForceEffect",
    "ParameterEffect",
    "SensorEffect",
    "Uneven",
]


LONGEST_TIME = 3.0
"""Time steps that the default priors of delays and lags reach at least."""


def _upper_end(prior: Distribution) -> float:
    """Returns where a range that begins at zero ends; infinity for other priors."""
    if isinstance(prior, Uniform) and float(prior.low) == 0.0:
        return float(prior.high)
    return math.inf


class Effect(ABC):
    """One physical cause with a law, parameters with units and priors, and a port.

    The parameters' nominal value is zero strength: with it the simulator reproduces its
    trajectory without the effect bit for bit.

    Args:
        port: Name of the port to attach to.
        priors: Priors that replace the effect's own, by parameter name.

    Attributes:
        id: Name in code and JSON, e.g. ``"coulomb_friction"``.
        port_kinds: Kinds of port the effect can attach to.
        parameters: Its parameters; ``{port}`` in a unit stands for the port's unit,
            ``{coordinate}`` for that of the joint's position.
        strength: Names of the parameters that scale the effect from zero; the others give it its
            shape, and their nominal values are those of a typical device. Empty for all.
        is_smooth: Whether trajectories are differentiable in the strengths at zero. Where they
            are not, sensitivities take finite steps of the size that :meth:`probe` gives.
        is_resonant: Whether it swings at a rate that its strength sets, a time constant. Of two
            sizes none is more of the other, so that a search tries many.
        has_local_minima: Whether the misfit has local minima along its parameters, as where parts
            hit each other: a hit one sample earlier makes another motion. Fits then also restart.
        is_noise: Whether it only scatters readings about the truth. No search asks for such an
            effect: a fit that simulates the scatter follows it by chance.
        wave: Name of the parameter that is the frequency in Hz of a wave in time, empty if none
            is. Priors are too wide to meet a wave's frequency, so a search reads it from the
            spectrum of what the model leaves over, and counts all frequencies it looked at.
        incidental: Names of shapes that a law may be without and still be the same cause.
        law: The law in one formula.
        equivalence: Causes that it may not be told from.
        excitation: The experiment that reveals it best.
        reference: Where the law is from.
    """

    id: ClassVar[str]
    port_kinds: ClassVar[tuple[PortKind, ...]]
    parameters: ClassVar[tuple[Parameter, ...]]
    strength: ClassVar[tuple[str, ...]] = ()
    is_smooth: ClassVar[bool] = True
    is_resonant: ClassVar[bool] = False
    has_local_minima: ClassVar[bool] = False
    is_noise: ClassVar[bool] = False
    wave: ClassVar[str] = ""
    incidental: ClassVar[tuple[str, ...]] = ()
    law: ClassVar[str] = ""
    equivalence: ClassVar[tuple[EquivalenceClass, ...]] = ()
    excitation: ClassVar[Excitation] = "wide_range"
    reference: ClassVar[str] = ""

    def __init__(self, port: str, *, priors: Mapping[str, Distribution] | None = None) -> None:
        self.port = port
        self._priors = dict(priors or {})
        unknown = sorted(set(self._priors) - {parameter.name for parameter in self.parameters})
        if unknown:
            raise ModelError(
                f"{self.id} has no parameter {', '.join(unknown)}; it has "
                f"{', '.join(parameter.name for parameter in self.parameters)}."
            )

    @abstractmethod
    def default_priors(self, port: Port) -> dict[str, Distribution]:
        """Returns the priors of all parameters, scaled to the port's rated value."""

    @property
    def given_priors(self) -> Mapping[str, Distribution]:
        """Priors that its user gave, by parameter name."""
        return self._priors

    def priors(self, port: Port) -> dict[str, Distribution]:
        """Returns the priors of all parameters, the user's where given."""
        return {**self.default_priors(port), **self._priors}

    def at_rate(self, port: Port, time_step: float) -> Self:
        """Returns the effect with priors of times that reach ``LONGEST_TIME`` time steps.

        A recording cannot tell times that are much shorter than its time step, and devices that
        are sampled slowly have delays and lags of several steps. Priors that the user gave, and
        those that reach further, stay.

        Args:
            port: The port it attaches to.
            time_step: Seconds between the recording's samples.
        """
        longest = LONGEST_TIME * time_step
        wider = {
            parameter.name: Uniform(0.0, longest)
            for parameter in self.parameters
            if parameter.unit == "s"
            and parameter.name not in self._priors
            and _upper_end(self.priors(port)[parameter.name]) < longest
        }
        if not wider:
            return self
        changed = copy.copy(self)
        changed._priors = {**self._priors, **wider}
        return changed

    def probe(self, port: Port) -> dict[str, float]:
        """Returns a typical value of every parameter: the effect switched on.

        Strengths are as far from zero strength as the priors expect (root mean square), shapes
        are nominal.
        """
        priors = self.default_priors(port)
        result = {}
        for parameter in self.parameters:
            result[parameter.name] = parameter.nominal
            if parameter.name in (self.strength or (parameter.name,)):
                prior = priors[parameter.name]
                offset = prior.mean - parameter.nominal
                result[parameter.name] += float((prior.variance + offset**2).sqrt())
        return result

    def suits(self, port: Port) -> bool:
        """Returns whether the law makes sense at a port of the right kind."""
        return True

    def units(self, port: Port) -> dict[str, str]:
        """Returns the unit of each parameter at a port."""
        return {
            p.name: p.unit.format(port=port.unit, coordinate=port.coordinate)
            for p in self.parameters
        }

    @property
    def name(self) -> str:
        """``"<port>.<effect>"``, unique within a simulator."""
        return f"{self.port}.{self.id}"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the sample sites: ``"<port>.<effect>.<parameter>"``."""
        return tuple(f"{self.name}.{parameter.name}" for parameter in self.parameters)

    def own_parameters(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Picks this effect's parameters by their short names; missing ones have no strength."""
        some = next(iter(parameters.values()), torch.zeros(()))
        return {
            parameter.name: parameters[site]
            if site in parameters
            else torch.as_tensor(parameter.nominal, dtype=some.dtype, device=some.device)
            for parameter, site in zip(self.parameters, self.parameter_names, strict=True)
        }

    def __repr__(self) -> str:
        return f"{type(self).__name__}(port={self.port!r})"


class ForceEffect(Effect):
    """An effect at a joint: a generalised force, a dry friction, or both.

    Attributes:
        needs_joint: Whether :meth:`begin_step` is called, which costs the engine two evaluations
            of the accelerations per step.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("force",)
    needs_joint: ClassVar[bool] = False

    def initial_memory(self, position: Tensor, velocity: Tensor, start: Start) -> Any:
        """Returns the effect's own state at a segment's start; ``None`` if it has none."""
        return None

    def begin_step(
        self, joint: Joint, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> Any:
        """Returns the memory with what the step's forces need to know of the joint.

        Called before :meth:`force` and :meth:`dry_friction` if ``needs_joint``. A stiff law can
        solve for its mean force over the step here, keep it in the memory and return it from
        :meth:`force`.
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

        Evaluated within the integrator's stages.
        """
        return None

    def moment(self, parameters: Mapping[str, Tensor], memory: Any) -> Tensor | None:
        """Returns the first moment of the force within a step, or ``None`` if it is constant.

        ∫ (t − h/2) f dt about the middle of a step of length h, in the force's unit times s², of
        an effect that asks for its joint; see :class:`Uneven`. Engines that hold forces for a step
        make do without.
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

        The engine applies up to this much against the motion, and at rest just what keeps the
        joint at rest (stiction): the set-valued law of Coulomb, solved within a step instead of
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
    """A force that is linear in base parameters, f = Σ_i φ_i(q, q̇) b_i, once the joint moves.

    By default the base parameters b are the effect's own parameters. Dry friction is linear in
    its magnitudes while the joint moves; at rest it is whatever holds the joint, and its columns
    are zero.
    """

    @abstractmethod
    def columns(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Returns φ_i, the force per unit of each base parameter, shaped like the position."""

    def to_base(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Returns the base parameters b that stand for the effect's parameters (short names)."""
        return tuple(parameters[parameter.name] for parameter in self.parameters)

    def from_base(self, base: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """Returns the parameters by short name; the inverse of :meth:`to_base`."""
        return {p.name: value for p, value in zip(self.parameters, base, strict=True)}


class Commands(ABC):
    """The commands given so far, as an action effect sees them."""

    @abstractmethod
    def now(self) -> Tensor:
        """Returns the present command."""

    @abstractmethod
    def delayed(self, steps: Tensor) -> Tensor:
        """Returns the command of ``steps`` (whole numbers, ≥ 0) steps ago, batch-wise."""


class Uneven(NamedTuple):
    """A command that changes within a step.

    Velocities move as far as under its mean, and positions lag as its moment says. Engines that
    hold a command for a step make do with the mean.

    Attributes:
        mean: Its mean, in its unit.
        moment: Its first moment ∫ (t − h/2) u dt about the middle of a step of length h, in its
            unit times s².
    """

    mean: Tensor
    moment: Tensor


class ActionEffect(Effect):
    """An effect on a command on its way to the dynamics."""

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("action",)

    def initial_memory(self, command: Tensor, start: Start) -> Any:
        """Returns the effect's own state when ``command`` has been given for long.

        ``None`` if it has none.
        """
        return None

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns the number of past commands that :meth:`act` may ask for."""
        return 0

    @abstractmethod
    def act(
        self, commands: Commands, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> "tuple[Tensor | Uneven, Any]":
        """Returns what reaches the dynamics during this step, and the next memory."""


class SensorEffect(Effect):
    """An effect between the true value of a channel and its reading.

    Attributes:
        needs_past: Whether its memory starts from :attr:`Start.changes`.
        spans: The channels that one device may have it on, with the same parameters.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("sensor",)
    needs_past: ClassVar[bool] = False
    spans: ClassVar[tuple[SensorSpan, ...]] = ("position", "rate", "positions", "rates")

    def history(self, parameters: Mapping[str, Tensor], time_step: float) -> int:
        """Returns the number of past true values that the memory is to hold."""
        return 0

    def initial_memory(self, value: Tensor, reading: Tensor, start: Start) -> Any:
        """Returns the effect's own state at a segment's start; ``None`` if it has none.

        Args:
            value: True value of the channel at the start.
            reading: What the sensor reported there.
            start: What else is known.
        """
        return None

    def initial_value(self, reading: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the true value at a segment's start behind what was read there.

        By default the reading itself; an offset or a wrong scale has to be taken out, or
        re-synchronised segments would start from the wrong state.
        """
        return reading

    def initial_rate(self, rate: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the true rate of change behind one that was derived from successive readings.

        By default the rate itself; a wrong scale, of the readings or of their time stamps, has to
        be taken out.
        """
        return rate

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor | None:
        """Returns by how many seconds readings are ahead of the truth; ``None`` for not at all.

        Negative for a delay. A segment whose state was read too late starts from where it has come
        to since.

        Args:
            parameters: The effect's parameters by short name.
            time: Seconds since the rollout began.
        """
        return None

    @abstractmethod
    def read(
        self, value: Tensor, parameters: Mapping[str, Tensor], memory: Any, time_step: float
    ) -> tuple[Tensor, Any]:
        """Returns the reading after a step, and the next memory."""


class EnvironmentEffect(Effect):
    """An effect that changes a quantity of the environment before the simulation starts."""

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("environment",)

    @abstractmethod
    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the changed quantity, e.g. the gravity vector (x, y, z) in m/s²."""


class ParameterEffect(Effect):
    """An effect that changes a domain parameter from segment to segment.

    Every domain parameter is a port. Within a segment the parameter is constant.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("parameter",)

    @abstractmethod
    def change(self, value: Tensor, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor:
        """Returns the domain parameter during a segment.

        Args:
            value: The domain parameter.
            parameters: The effect's parameters by short name.
            time: Seconds from the rollout's beginning to the segment's middle.
        """
