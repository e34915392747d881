"""The protocol of a simulator: anything that maps parameters and inputs to a trajectory."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.errors import DataError, ModelError
from npdr_ppl.language.channels import Channel, Follower, Parameter, Port, Spin, find_port
from npdr_ppl.language.effects import (
    ComplianceEffect,
    Effect,
    ForceEffect,
    ParameterEffect,
    ServoEffect,
)
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.linear_dynamics import InverseDynamics

__all__ = ["Simulator"]

MAX_STEP_RATIO = 200.0
"""Largest ratio of a recording's time step to the simulator's. Above it, time cannot be in s:
milliseconds give a ratio of 1000, or 250 if the recording is four times as dense."""


class Simulator(ABC):
    """Maps domain parameters and inputs to the measurements of a trajectory, in batches.

    A subclass declares the attributes and implements :meth:`simulate`. Simulators are immutable:
    :meth:`with_effects` returns a changed copy.

    Attributes:
        states: The state's components.
        actions: The action channels.
        sensors: The channels of a trajectory, which the sensors measure.
        parameters: Domain parameters with nominal values; a parameter that a model does not
            sample keeps its nominal value.
        ports: Places where effects attach; :attr:`all_ports` also has those without declaration.
        time_step: Seconds per step.
        is_deterministic: Whether equal parameters and inputs give equal trajectories.
        is_differentiable: Whether gradients flow from trajectories to parameters.
        uses_threads: Whether a batch is simulated on several threads, so that further processes
            would save no time.
        takes_servo_effects: Whether effects inside servos can be attached.
        takes_compliance: Whether joints can have carriers that yield.
        effects: The effects attached, in the order of attachment.
        inverse_dynamics: The equations of motion in the form for linear regression; ``None`` if
            not declared.
    """

    states: tuple[Channel, ...]
    actions: tuple[Channel, ...]
    sensors: tuple[Channel, ...]
    parameters: tuple[Parameter, ...]
    ports: tuple[Port, ...] = ()
    time_step: float
    is_deterministic: bool = True
    is_differentiable: bool = False
    uses_threads: bool = False
    takes_servo_effects: bool = False
    takes_compliance: bool = False
    effects: tuple[Effect, ...] = ()
    inverse_dynamics: InverseDynamics | None = None

    @abstractmethod
    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions from the inputs' initial states.

        Args:
            parameters: Values by name, in the declared units, each of a shape that broadcasts to
                the batch shape B. Missing ones are nominal. Parameters of attached effects are
                named ``"<port>.<effect>.<parameter>"``.
            inputs: Segments to simulate.

        Returns:
            Measurements *after* each step, shape ``B + (segments, steps, sensors)``, in the
            sensors' units; zero where ``inputs.mask`` is false.
        """

    @property
    def name(self) -> str:
        """Name for messages."""
        return type(self).__name__

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy with effects attached after the present ones.

        Raises:
            ModelError: A port does not exist, has the wrong kind, or the effect is there already.
        """
        changed = copy.copy(self)
        for effect in effects:
            port = self.port(effect.port)
            if port.kind not in effect.port_kinds:
                suitable = [p.name for p in self.all_ports if p.kind in effect.port_kinds]
                raise ModelError(
                    f"{effect.id} attaches to a port of kind {' or '.join(effect.port_kinds)}, "
                    f"but {port.name!r} of {self.name} is of kind {port.kind}; suitable are "
                    f"{', '.join(suitable) or 'none of its ports'}."
                )
            if len(port.channels) > 1 and not effect.may_cover_several:
                raise ModelError(
                    f"{effect.id} attaches to one port; attach it to each of {port.name}."
                )
            if isinstance(effect, ServoEffect) and not self.takes_servo_effects:
                raise ModelError(
                    f"{self.name} cannot apply {effect.id}, an effect inside a servo."
                )
            if isinstance(effect, ComplianceEffect) and not self.takes_compliance:
                raise ModelError(f"{self.name} cannot apply {effect.id}, which adds a joint.")
            if port.is_floating and not _may_float(effect):
                raise ModelError(
                    f"{effect.id} cannot attach to {port.name!r} of {self.name}: a body that "
                    "floats has no position there, no bearing that rubs and no joint."
                )
            if not effect.suits(port):
                raise ModelError(
                    f"{effect.id} makes no sense at the port {port.name!r} of {self.name}, "
                    f"through which pass {port.unit}."
                )
            if effect.name in {present.name for present in changed.effects}:
                raise ModelError(f"{effect.name} is attached to {self.name} already.")
            changed.effects = (*changed.effects, effect)
        return changed

    def is_goal(self, action: str) -> bool:
        """Returns whether an action is the goal of a servo."""
        return any(port.name == action and port.kind == "servo" for port in self.ports)

    def corrected_number(self, effect: Effect) -> str:
        """Returns the uncertain number of the model that an effect would correct; empty if none.

        Recordings do not determine this number beside the parameters, so it is not a parameter
        itself. Another effect can make it determinable. A correction is no missing effect, and
        can have either sign.

        Args:
            effect: An effect that can be attached.
        """
        return ""

    def speeds_at_starts(self, inputs: Inputs) -> dict[str, Tensor]:
        """Returns the velocities at force ports whose rated speed is a guess, ``(S,)`` by port.

        There are none where the author of the model states the speeds.

        Args:
            inputs: The segments, at whose starts they are.
        """
        return {}

    @property
    def rate_lag(self) -> float:
        """Time between the state's rates and the derivatives of its positions, in time steps."""
        return 0.0

    def with_finer_steps(self) -> Self | None:
        """Returns a copy with smaller integration errors; ``None`` if there is none."""
        return None

    def with_coarser_steps(
        self, num_simulations: float = math.inf, time_step: float | None = None
    ) -> Self | None:
        """Returns a copy that costs less, from which finer steps differ almost constantly.

        Differences between simulations of similar parameters are then almost the same in both.
        ``None`` if there is no such copy, or if it saves nothing.

        Args:
            num_simulations: How many simulations of a segment it would be used for. One more of
                every segment with each of both steps tells what the coarser ones miss.
            time_step: Seconds per step of the recording; the simulator's own by default.
        """
        return None

    @property
    def is_rate(self) -> tuple[bool, ...]:
        """Whether each state is the rate of another; the others are positions."""
        return tuple(state.rate_of is not None for state in self.states)

    @property
    def followers(self) -> tuple[Follower | Spin, ...]:
        """States that need not be recorded, because they follow from others."""
        return ()

    @property
    def all_ports(self) -> tuple[Port, ...]:
        """The declared ports, the clock, and every domain parameter whose name is not a port's."""
        implied = (
            Port("clock", "clock", "s", rated=1.0),
            *(
                Port(p.name, "parameter", p.unit, rated=abs(p.nominal) or 1.0)
                for p in self.parameters
            ),
        )
        declared = {port.name for port in self.ports}
        return (*self.ports, *(port for port in implied if port.name not in declared))

    def port(self, name: str) -> Port:
        """Returns the port called ``name``; see :class:`Port` for groups."""
        return find_port(self.all_ports, name, self.name)

    def check_parameters(self, parameters: Mapping[str, Tensor]) -> None:
        """Raises a ModelError that lists parameters this simulator does not have."""
        known = {parameter.name for parameter in self.parameters}
        known |= {name for effect in self.effects for name in effect.parameter_names}
        unknown = sorted(set(parameters) - known)
        if unknown:
            raise ModelError(
                f"{self.name} has no parameter {', '.join(unknown)}; "
                f"it has {', '.join(sorted(known))}."
            )

    def check_inputs(self, inputs: Inputs) -> None:
        """Raises a DataError if the inputs' channels or time step do not fit."""
        missing = [a.name for a in self.actions if a.name not in inputs.action_names]
        if missing:
            raise DataError(
                f"{self.name} needs the action {', '.join(missing)}; the data have "
                f"{', '.join(inputs.action_names) or 'no actions'}."
            )
        if inputs.time_step > MAX_STEP_RATIO * self.time_step:
            raise DataError(
                f"The time steps of the data are {inputs.time_step:g} s, but {self.name} takes "
                f"steps of {self.time_step:g} s; time has to be in seconds, is it in milliseconds?"
            )

    def initial_states(self, inputs: Inputs) -> tuple[Tensor, ...]:
        """Returns each state component at the start of each segment, ``(..., S)`` each.

        A rate whose position is measured comes from the estimated derivative of the position if
        the inputs have one, otherwise from its own measurement. At a rollout's first sample the
        derivative uses later samples only, so a measured rate is more accurate and preferred.

        Raises:
            DataError: A component was not recorded and cannot be estimated.
        """
        columns = {name: i for i, name in enumerate(inputs.channel_names)}
        result = []
        for state in self.states:
            if inputs.initial_rates is not None and state.rate_of in columns:
                rate = inputs.initial_rates[..., columns[state.rate_of]]
                if state.name in columns:
                    value = inputs.initial_values[..., columns[state.name]]
                    rate = torch.where(inputs.start.to(rate.device) == 0, value, rate)
                result.append(rate)
            elif state.name in columns:
                result.append(inputs.initial_values[..., columns[state.name]])
            else:
                raise DataError(
                    f"{state.name} was not recorded, so the state at a segment's start is "
                    "unknown; use initial_state='estimated' with measurements of "
                    f"{state.rate_of or state.name}."
                )
        return tuple(result)

    def recorded_settings(self) -> dict[str, Any]:
        """Returns settings of the engine that are a part of the model, for reports.

        Empty by default; values must be JSON types.
        """
        return {}

    def nominal(self) -> dict[str, Tensor]:
        """Returns the nominal parameters as scalar float64 tensors."""
        return {
            parameter.name: torch.tensor(parameter.nominal, dtype=torch.float64)
            for parameter in self.parameters
        }

    def complete(
        self, parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> dict[str, Tensor]:
        """Returns all parameters including those of effects; missing ones are nominal.

        Args:
            parameters: Some of the parameters, tensors or numbers.
            dtype: Floating type of the result.
            device: Device of the result.
        """
        values = {parameter.name: parameter.nominal for parameter in self.parameters}
        for effect in self.effects:
            nominal = [parameter.nominal for parameter in effect.parameters]
            values |= dict(zip(effect.parameter_names, nominal, strict=True))
        return {
            name: torch.as_tensor(value, dtype=dtype, device=device)
            for name, value in {**values, **parameters}.items()
        }

    def changed(self, parameters: Mapping[str, Tensor], time: Tensor) -> dict[str, Tensor]:
        """Returns all parameters after parameter effects have changed the domain parameters.

        Args:
            parameters: Result of :meth:`complete`.
            time: Seconds from the start of the rollout to the middle of each segment.
        """
        result = dict(parameters)
        for effect in self.effects:
            if isinstance(effect, ParameterEffect):
                own = effect.own_parameters(parameters)
                result[effect.port] = effect.change(result[effect.port], own, time)
        return result


def _may_float(effect: Effect) -> bool:
    """Returns whether an effect can attach to an axis of a floating body."""
    return (
        isinstance(effect, ForceEffect)
        and effect.acts_on_floating
        and not effect.needs_joint
        and type(effect).dry_friction is ForceEffect.dry_friction
    )
