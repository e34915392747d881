"""A plain function of batched parameters, initial states and actions as a simulator."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.engines.common.signals import Signals, domain_by_segment, needs_accelerations
from npdr_ppl.errors import ModelError, SimulationError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.effects import Effect, SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

__all__ = ["BatchedFunction", "FunctionSimulator"]

BatchedFunction = Callable[[dict[str, Tensor], Tensor, Tensor, float], Tensor]
"""``f(parameters, initial_state, actions, time_step)``: parameters by name, ``(N,)`` each; initial
states ``(N, states)``; actions ``(N, steps, actions)``, each held for a step; seconds per step.
Returns the states after each step, ``(N, steps, states)``."""


class FunctionSimulator(Simulator):
    """A function that simulates many draws at once, as a simulator.

    Effects on commands, measurements, the clock and parameters attach to it. Forces would have to
    act inside the function; derive from ``ODESimulator`` for those.

    Args:
        function: The function, see :data:`BatchedFunction`. It gets float64 tensors.
        states: The state's components, which are also what is measured.
        parameters: Domain parameters with nominal values.
        actions: The action channels; none for free motion. Commands are clamped to their bounds.
        time_step: Seconds per step that the function is meant for.
        is_differentiable: Whether gradients flow from trajectories to parameters.

    Raises:
        ModelError: Names are repeated, or there is no state.

    Example:
        >>> import torch, npdr_ppl as npdr
        >>> def fall(parameters, initial_state, actions, time_step):
        ...     height, speed = initial_state.unbind(-1)
        ...     time = time_step * torch.arange(1, actions.shape[1] + 1)
        ...     gravity = parameters["gravity"][:, None]
        ...     return torch.stack(
        ...         [height[:, None] + speed[:, None] * time - 0.5 * gravity * time**2,
        ...          speed[:, None] - gravity * time], dim=-1,
        ...     )
        >>> falling = npdr.FunctionSimulator(
        ...     fall,
        ...     states=[
        ...         npdr.Channel("height", "m"),
        ...         npdr.Channel("speed", "m/s", rate_of="height"),
        ...     ],
        ...     parameters=[npdr.Parameter("gravity", "m/s²", 9.81)],
        ...     time_step=0.05,
        ... )
        >>> falling.name
        'fall'
    """

    def __init__(
        self,
        function: BatchedFunction,
        *,
        states: Sequence[Channel],
        parameters: Sequence[Parameter],
        actions: Sequence[Channel] = (),
        time_step: float,
        is_differentiable: bool = False,
    ) -> None:
        self.function = function
        self.states = self.sensors = tuple(states)
        self.actions = tuple(actions)
        self.parameters = tuple(parameters)
        self.time_step = time_step
        self.is_differentiable = is_differentiable
        names = [part.name for part in (*states, *actions, *parameters)]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ModelError(f"{self.name}: {', '.join(repeated)} has two meanings.")
        if not states:
            raise ModelError(f"{self.name} has no states.")
        self.ports = tuple(
            [Port(a.name, "action", a.unit, rated=_rated(a)) for a in actions]
            + [Port(s.name, "sensor", s.unit, rated=_rated(s)) for s in states]
        )

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.function, "__name__", type(self.function).__name__)

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy with effects attached; see :meth:`Simulator.with_effects`.

        Raises:
            ModelError: A sensor effect needs accelerations, which a function does not give.
        """
        for effect in effects:
            if isinstance(effect, SensorEffect) and needs_accelerations(effect):
                raise ModelError(
                    f"{effect.id} cannot attach to {effect.port!r} of {self.name}: it needs "
                    "accelerations at a segment's start, which a function does not give."
                )
        return super().with_effects(*effects)

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions; see :meth:`Simulator.simulate`.

        Raises:
            SimulationError: The function returned something else than a trajectory.
        """
        self.check_parameters(parameters)
        self.check_inputs(inputs)
        dtype = inputs.actions.dtype
        inputs = inputs.to(dtype=torch.float64)
        domain, shape = domain_by_segment(self, parameters, inputs)
        signals = Signals(self, domain, inputs, shape)
        initial_states = signals.initial_states()
        own = {p.name: domain[p.name].expand(shape).reshape(-1) for p in self.parameters}
        values = self._run(own, initial_states, signals.actions(), inputs.time_step)
        readings = signals.readings(values, initial_states)
        readings = readings.reshape(*shape, *readings.shape[1:])
        readings = torch.where(inputs.mask[..., None], readings, torch.zeros_like(readings))
        return readings.to(dtype)

    def _run(
        self, parameters: dict[str, Tensor], initial_states: Tensor, actions: Tensor, step: float
    ) -> Tensor:
        """Returns the states after each step, ``(N, steps, states)``."""
        result: Any = self.function(parameters, initial_states, actions, step)
        expected = (len(initial_states), actions.shape[1], len(self.states))
        if not isinstance(result, Tensor) or tuple(result.shape) != expected:
            found = tuple(result.shape) if isinstance(result, Tensor) else type(result).__name__
            raise SimulationError(
                f"{self.name} should return the states after each step, a tensor of shape "
                f"{expected}; got {found}."
            )
        if result.is_complex():
            raise SimulationError(f"{self.name} returned complex numbers.")
        return result.to(torch.float64)


def _rated(channel: Channel) -> float:
    """Returns a typical size of a channel: its bound, or one."""
    bound = max(abs(channel.lower), abs(channel.upper))
    return bound if 0.0 < bound < float("inf") else 1.0
