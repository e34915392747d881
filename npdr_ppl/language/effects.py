"""Effects: physical causes that a simulator may lack, declared once and attached to ports.

An effect consists of data and one law. The law uses plain tensors with batch dimensions, so any
engine that provides velocities, commands or measurements can apply it.
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
    "ServoEffect",
    "Uneven",
    "upper_end",
]


LONGEST_TIME = 3.0
"""Default priors of delays and lags reach at least this many time steps."""


def upper_end(prior: Distribution) -> float:
    """Returns the upper end of a range that begins at zero; infinity for other priors."""
    if isinstance(prior, Uniform) and float(prior.low) == 0.0:
        return float(prior.high)
    return math.inf


class Effect(ABC):
    """One physical cause with a law, parameters with units and priors, and a port.

    The parameters' nominal values mean zero strength: with them the simulator reproduces its
    trajectory without the effect bit for bit.

    Args:
        port: Name of the port to attach to.
        priors: Priors that replace the effect's default priors, by parameter name.

    Attributes:
        id: Name in code and JSON, e.g. ``"coulomb_friction"``.
        port_kinds: Kinds of port the effect can attach to.
        parameters: Its parameters; ``{port}`` in a unit stands for the port's unit,
            ``{coordinate}`` for that of the joint's position, ``{force}`` for that of the joint's
            force.
        strength: Names of the parameters that scale the effect from zero; the others set its
            shape, and their nominal values are those of a typical device. Empty for all.
        is_smooth: Whether trajectories are differentiable in the strengths at zero. If not,
            sensitivities use finite steps of the size that :meth:`probe` gives.
        is_resonant: Whether the effect oscillates at a rate that its strength, a time constant,
            sets. The effect then does not simply grow with its strength, so a search tries many
            values.
        has_local_minima: Whether the misfit has local minima along its parameters, e.g. for parts
            that collide: a collision one sample earlier changes the motion. Fits then also
            restart.
        is_noise: Whether it only scatters measurements about the true value. Searches leave out
            such effects, because a fit that simulates the scatter follows the data by chance.
        wave: Name of the parameter that is the frequency in Hz of a wave in time, empty if none
            is. Priors are too wide to hit a wave's frequency, so a search takes it from the
            spectrum of the residuals and corrects for the number of frequencies it examined.
        has_ripples: Whether it repeats a whole and unknown number of times per turn of a joint. A
            search finds the number in the same way, and sets it by :meth:`with_ripples`.
        incidental: Names of shape parameters without which the law is still the same cause.
        per_recording: Names of parameters that may have another value in each recording of one
            device, as the zero of an encoder that is switched on anew.
        contains: Ids of the simpler laws at the same port whose sum it equals at a limit of its
            shape.
        beside: Ids of laws at the same port that act together with it, and that it does not
            replace. A search adds one of them if that makes an implausible shape plausible.
        law: The law in one formula.
        equivalence: Causes that may be indistinguishable from it.
        excitation: The experiment that reveals it best.
        reference: Source of the law.
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
    has_ripples: bool = False
    incidental: ClassVar[tuple[str, ...]] = ()
    per_recording: ClassVar[tuple[str, ...]] = ()
    contains: ClassVar[tuple[str, ...]] = ()
    beside: ClassVar[tuple[str, ...]] = ()
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
        """Priors that the user gave, by parameter name."""
        return self._priors

    def priors(self, port: Port) -> dict[str, Distribution]:
        """Returns the priors of all parameters, the user's where given."""
        return {**self.default_priors(port), **self._priors}

    def at_rate(self, port: Port, time_step: float) -> Self:
        """Returns the effect with priors of times that reach at least ``LONGEST_TIME`` time steps.

        A recording cannot resolve times much shorter than its time step, and devices with slow
        sampling have delays and lags of several steps. Priors that the user gave, and longer
        ones, are kept.

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
            and upper_end(self.priors(port)[parameter.name]) < longest
        }
        if not wider:
            return self
        changed = copy.copy(self)
        changed._priors = {**self._priors, **wider}
        return changed

    def probe(self, port: Port) -> dict[str, float]:
        """Returns a typical value of every parameter, with the effect switched on.

        The distance of strengths from zero strength is the root mean square under the priors;
        limits have their mean under the priors, and shape parameters are nominal.
        """
        priors = self.default_priors(port)
        result = {}
        for parameter in self.parameters:
            prior = priors[parameter.name]
            result[parameter.name] = parameter.nominal
            if math.isinf(parameter.nominal):
                result[parameter.name] = float(prior.mean)
            elif parameter in self.strengths:
                offset = prior.mean - parameter.nominal
                result[parameter.name] += float((prior.variance + offset**2).sqrt())
        return result

    def suits(self, port: Port) -> bool:
        """Returns whether the law makes sense at a port of the right kind."""
        return True

    def units(self, port: Port) -> dict[str, str]:
        """Returns the unit of each parameter at a port."""
        own = {"port": port.unit, "coordinate": port.coordinate, "force": port.force_unit}
        return {p.name: p.unit.format(**own) for p in self.parameters}

    @property
    def strengths(self) -> tuple[Parameter, ...]:
        """The parameters that scale it from zero; see :attr:`strength`."""
        chosen = self.strength or tuple(p.name for p in self.parameters)
        return tuple(p for p in self.parameters if p.name in chosen)

    @property
    def name(self) -> str:
        """``"<port>.<effect>"``, unique within a simulator."""
        return f"{self.port}.{self.id}"

    @property
    def constants(self) -> dict[str, float]:
        """Numbers of the law that a fit does not change, by name."""
        return {}

    def with_ripples(self, number: int) -> Self:
        """Returns the effect with another number of ripples per turn; see :attr:`has_ripples`."""
        return self

    @property
    def may_cover_several(self) -> bool:
        """Whether it may attach to a group of ports; see :class:`Port`."""
        return False

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, or of the one other place, that its port covers."""
        return tuple(self.port.split(","))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the sample sites: ``"<port>.<effect>.<parameter>"``."""
        return tuple(f"{self.name}.{parameter.name}" for parameter in self.parameters)

    def own_parameters(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns this effect's parameters by short name; missing ones are nominal."""
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
    """An effect at a joint: a generalised force, dry friction, or both.

    Attributes:
        needs_joint: Whether :meth:`begin_step` is called, which costs the engine two evaluations
            of the accelerations per step.
        needs_past: Whether its initial memory needs :attr:`Start.displacements`.
        standard_law: ``"damping"`` with the parameter ``damping``, or ``"spring"`` with
            ``stiffness`` and ``rest``, if the law is one that engines have themselves; else empty.
            A subclass with another law makes it empty.
    """

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("force",)
    needs_joint: ClassVar[bool] = False
    needs_past: ClassVar[bool] = False
    standard_law: ClassVar[str] = ""

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
        an effect with ``needs_joint``; see :class:`Uneven`. Engines that hold forces constant for
        a step ignore it.
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
    ) -> "tuple[Tensor | Uneven, Any]":
        """Returns the command that reaches the dynamics in this step, and the next memory."""


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
            error: Goal minus position, ``(N,)``.
            parameters: The effect's parameters by short name.
            memory: The effect's own state at the start of the step.
        """

    def next_memory(
        self,
        error: Tensor,
        parameters: Mapping[str, Tensor],
        memory: Tensor | None,
        time_step: float,
    ) -> Tensor | None:
        """Returns the effect's own state after a step of ``time_step`` seconds with an error."""
        return memory


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

    def initial_rate(self, rate: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Returns the true rate of change for a rate derived from successive measurements.

        By default it is the rate itself. Effects with a wrong scale of measurements or time stamps
        must remove it.
        """
        return rate

    def lead(self, parameters: Mapping[str, Tensor], time: Tensor) -> Tensor | None:
        """Returns by how many seconds measurements lead the true values; ``None`` for zero.

        A delay is negative. The initial state of a segment is moved forward in time by the delay
        of its measurement.

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


class EnvironmentEffect(Effect):
    """An effect that changes a quantity of the environment before the simulation starts."""

    port_kinds: ClassVar[tuple[PortKind, ...]] = ("environment",)

    @abstractmethod
    def environment(self, value: Any, parameters: Mapping[str, Tensor]) -> Any:
        """Returns the changed quantity.

        Examples are the gravity vector (x, y, z) in m/s², and the
        :class:`~npdr_ppl.language.effect_context.Servo` at a servo's port.
        """


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
