"""What every effect has: a law, parameters with units and priors, and a port."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import ClassVar, Self

import torch
from pyro.distributions import Normal, Uniform
from torch import Tensor
from torch.distributions import Distribution, HalfNormal

from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter, Port, PortKind
from npdr_ppl.language.effect_context import EquivalenceClass, Excitation
from npdr_ppl.language.wider_priors import widened

__all__ = ["Effect", "upper_end"]


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
        is_smooth: Whether trajectories change in proportion to small strengths, up to typical
            ones. If not, a search tries the sizes that :meth:`probe` gives, of both signs if all
            strengths can be negative.
        is_resonant: Whether the effect oscillates at a rate that its strength, a time constant,
            sets. The effect then does not simply grow with its strength, so a search tries many
            values.
        has_local_minima: Whether the misfit has local minima along its parameters, e.g. for parts
            that collide: a collision one sample earlier changes the motion. Fits then also
            restart.
        is_noise: Whether it only scatters measurements about the true value. Searches leave out
            such effects, because a fit that simulates the scatter follows the data by chance.
        only_if_asked: Whether searches consider it only among candidates that the user names.
        wave: Name of the parameter that is the frequency in Hz of a wave in time, empty if none
            is. Priors are too wide to hit a wave's frequency, so a search takes it from the
            spectrum of the residuals and corrects for the number of frequencies it examined.
        rounds: Name of the strength that is the step to which it rounds commands, empty if none
            is. A slightly wrong step explains nothing, so a search takes it from the residuals.
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
    only_if_asked: ClassVar[bool] = False
    wave: ClassVar[str] = ""
    rounds: ClassVar[str] = ""
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
        return self._with_further_priors(wider)

    def at_speed(self, port: Port, speed: float) -> Self:
        """Returns the effect with priors that are as wide as at a lower rated speed.

        A force in proportion to the square of the velocity has a coefficient that is a hundred
        times as large if the same force acts at a tenth of the velocity. Priors that the user
        gave, and wider ones, are kept.

        Args:
            port: The port it attaches to.
            speed: Greatest speed of its joint in the recording.
        """
        if not 0.0 < speed < port.rated_speed:
            return self
        own = self.default_priors(port)
        wider = {
            name: prior
            for name, prior in self.default_priors(replace(port, rated_speed=speed)).items()
            if name not in self._priors and _variance(prior) > _variance(own[name])
        }
        return self._with_further_priors(wider)

    def of_either_sign(self, port: Port) -> Self:
        """Returns the effect with normal priors in place of half-normal ones.

        Args:
            port: The port it attaches to.
        """
        signed = {
            name: Normal(0.0, prior.scale)
            for name, prior in self.priors(port).items()
            if isinstance(prior, HalfNormal)
        }
        return self._with_further_priors(signed)

    def with_wider_priors(self, port: Port, names: Collection[str]) -> Self:
        """Returns the effect with wider priors of some parameters; see :func:`widened`.

        Args:
            port: The port it attaches to.
            names: The parameters; those with other kinds of priors keep them.
        """
        own = self.priors(port)
        wider = {name: widened(own[name]) for name in names}
        return self._with_further_priors({n: p for n, p in wider.items() if p is not None})

    def _with_further_priors(self, priors: Mapping[str, Distribution]) -> Self:
        """Returns a copy with further priors; the effect itself if there are none."""
        if not priors:
            return self
        changed = copy.copy(self)
        changed._priors = {**self._priors, **priors}
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


def _variance(prior: Distribution) -> float:
    """Returns a prior's variance, infinite if it does not tell it."""
    try:
        return float(prior.variance)
    except NotImplementedError:
        return math.inf
