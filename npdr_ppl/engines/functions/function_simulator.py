"""A plain function of batched parameters, initial states and actions as a simulator."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.signals import Signals, domain_by_segment, needs_accelerations
from npdr_ppl.engines.functions.forced_motion import ForcedMotion
from npdr_ppl.errors import ModelError, SimulationError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.effects import Effect, ForceEffect, SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

__all__ = ["BatchedFunction", "FunctionSimulator"]

FINER = 4
"""Finer steps in place of one, an even number. The time of a function in Python is proportional to
it."""

JUMP = 0.25
"""Difference between results in two step lengths, as a share of a state's range, above which the
state jumps."""

MOST_CHANGED = 0.5
"""By how much two halves of a step may differ from the whole, as a share of its change, if a
function uses the time step."""

LEAST_CHANGED = 0.1
"""By how much one half must differ from it. Without use of the time step it is the same."""

NUM_PROBES = 16
"""Number of random states and actions from which both are tried."""

BatchedFunction = Callable[..., Tensor]
"""``f(parameters, initial_state, actions, time_step)``: parameters by name, ``(N,)`` each; initial
states ``(N, states)``; actions ``(N, steps, actions)``, each held for a step; seconds per step.
Returns the states after each step, ``(N, steps, states)``. A function with force ports has a fifth
argument, generalised forces ``(N, steps, ports)``, each held for a step."""


class FunctionSimulator(Simulator):
    """A function that simulates many draws at once, as a simulator.

    Effects on commands, measurements, the clock and parameters attach to every function. Effects
    on forces attach if the function takes forces: it is then called for one step at a time, from
    the state after the one before, so it must not depend on earlier steps otherwise. Where the
    function's own integration is too coarse for a recording, it is called with shorter steps, if
    it uses the time step.

    Args:
        function: The function, see :data:`BatchedFunction`. It gets float64 tensors.
        states: The state's components, which are also what is measured.
        parameters: Domain parameters with nominal values.
        actions: The action channels; none for free motion. Commands are clamped to their bounds.
        time_step: Seconds per step that the function is meant for.
        forces: Force ports by the state, a position, that they act on, in the order of the
            function's last argument; none if it takes no forces.
        is_differentiable: Whether gradients flow from trajectories to parameters.

    Raises:
        ModelError: Names are repeated, there is no state, or a port does not act on a position
            whose rate is a state.

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

    _is_fine: bool = False
    """Whether the function is called with parts of the time step."""

    def __init__(
        self,
        function: BatchedFunction,
        *,
        states: Sequence[Channel],
        parameters: Sequence[Parameter],
        actions: Sequence[Channel] = (),
        time_step: float,
        forces: Mapping[str, Port] | None = None,
        is_differentiable: bool = False,
    ) -> None:
        self.function = function
        self.states = self.sensors = tuple(states)
        self.actions = tuple(actions)
        self.parameters = tuple(parameters)
        self.time_step = time_step
        self.is_differentiable = is_differentiable
        self.forces = dict(forces or {})
        names = [part.name for part in (*states, *actions, *parameters, *self.forces.values())]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ModelError(f"{self.name}: {', '.join(repeated)} has two meanings.")
        if not states:
            raise ModelError(f"{self.name} has no states.")
        self._joints = {
            _column(self, state, port): port.name for state, port in self.forces.items()
        }
        self._rates = tuple(_rate_column(self, state) for state in self.forces)
        self.ports = tuple(
            [Port(a.name, "action", a.unit, rated=_rated(a)) for a in actions]
            + [*self.forces.values()]
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

    def with_finer_steps(self) -> Self | None:
        """Returns a copy that calls the function with half and a quarter of the time step.

        The result is extrapolated from both. ``None`` if it does so already, or if the function
        does not use the time step.
        """
        if self._is_fine or not self._uses_time_step:
            return None
        changed = copy.copy(self)
        changed._is_fine = True
        return changed

    def with_coarser_steps(
        self, num_simulations: float = math.inf, time_step: float | None = None
    ) -> Self | None:
        """Returns a copy with the function's own steps; ``None`` if these are its steps."""
        if not self._is_fine:
            return None
        changed = copy.copy(self)
        changed._is_fine = False
        return changed

    @cached_property
    def _uses_time_step(self) -> bool:
        """Whether two halves of a step lead about where the whole leads, and one does not."""
        generator = torch.Generator().manual_seed(0)

        def drawn(channels: Sequence[Channel]) -> Tensor:
            sizes = torch.tensor([_rated(channel) for channel in channels], dtype=torch.float64)
            shape = NUM_PROBES, len(channels)
            values = torch.randn(shape, generator=generator, dtype=torch.float64) * sizes
            bounds = torch.tensor([[c.lower, c.upper] for c in channels], dtype=torch.float64)
            return values.clamp(*bounds.reshape(-1, 2).unbind(1))

        states, actions = drawn(self.states), drawn(self.actions)[:, None]
        nominal = {
            name: value.double().expand(NUM_PROBES, *value.shape)
            for name, value in self.nominal().items()
        }
        forces = states.new_zeros(NUM_PROBES, 1, len(self.forces))
        step, changes = self.time_step, []
        for num, length in ((1, step), (1, step / 2), (2, step / 2)):
            held, none = (part.expand(-1, num, -1) for part in (actions, forces))
            try:
                ends = self._called(nominal, states, held, length, none)
            except Exception:  # the function is the user's, and random states may not suit it
                return False
            changes.append(ends[:, -1] - states)
        size, half, halves = (
            (change - other).square().mean(0).sqrt()
            for change, other in zip(changes, (0.0, changes[0], changes[0]), strict=True)
        )
        return bool((halves <= MOST_CHANGED * size).all() & (half > LEAST_CHANGED * size).any())

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
        step, actions = inputs.time_step, signals.actions()
        laws = tuple(effect for effect in self.effects if isinstance(effect, ForceEffect))
        forced = copy.copy(self)
        forced.effects = laws
        own_tables = tuple(law.own_parameters(domain) for law in laws)
        tables = flatten(own_tables, shape, expand=True) if laws else ()

        def moved(num: int) -> Tensor:
            """Returns the states after each step, of which each is taken in equal parts."""
            held, length = actions.repeat_interleave(num, dim=1), step / num
            if not laws:
                none = held.new_zeros(*held.shape[:2], len(self.forces))
                return self._called(own, initial_states, held, length, none)[:, num - 1 :: num]

            def advance(states: Tensor, action: Tensor, forces: Tensor) -> Tensor:
                return self._called(own, states, action[:, None], length, forces[:, None])[:, 0]

            motion = ForcedMotion(forced, self._joints, self._rates, advance, length)
            states = motion.run(tables, initial_states, held, signals.start_times)
            return states[:, num - 1 :: num]

        values = moved(FINER if self._is_fine else 1)
        if self._is_fine:
            values = self._extrapolated(moved(FINER // 2), values)
        readings = signals.readings(values, initial_states)
        readings = readings.reshape(*shape, *readings.shape[1:])
        readings = torch.where(inputs.mask[..., None], readings, torch.zeros_like(readings))
        return readings.to(dtype)

    def _extrapolated(self, rough: Tensor, fine: Tensor) -> Tensor:
        """Returns states without the error that is proportional to the step (Richardson 1911).

        Where a state jumps within its bounds, as a wrapped angle does, it is left as it is. No
        state is moved beyond its bounds.

        Args:
            rough: The states in steps of twice the length, ``(N, steps, states)``.
            fine: The states.
        """
        bounds = torch.tensor([[state.lower, state.upper] for state in self.states]).to(fine)
        lower, upper = bounds.unbind(1)
        change = fine - rough
        jumps = change.abs() > JUMP * (upper - lower)
        moved = fine + torch.where(jumps, 0.0, change)
        return moved.maximum(lower.minimum(fine)).minimum(upper.maximum(fine))

    def _called(
        self,
        parameters: dict[str, Tensor],
        initial_states: Tensor,
        actions: Tensor,
        step: float,
        forces: Tensor,
    ) -> Tensor:
        """Returns the function's result, ``(N, steps, states)``."""
        given = (parameters, initial_states, actions, step)
        result: Any = self.function(*given, forces) if self.forces else self.function(*given)
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


def _column(simulator: FunctionSimulator, state: str, port: Port) -> int:
    """Returns the column of the position that a force port acts on."""
    positions = {s.name: i for i, s in enumerate(simulator.states) if s.rate_of is None}
    if port.kind != "force":
        raise ModelError(f"{port.name} is of kind {port.kind}; a port of forces is of kind force.")
    if state not in positions:
        raise ModelError(
            f"{port.name} should act on a position among the states "
            f"({', '.join(positions) or 'none'}), not on {state!r}."
        )
    return positions[state]


def _rate_column(simulator: FunctionSimulator, state: str) -> int:
    """Returns the column of the rate of a position."""
    for column, other in enumerate(simulator.states):
        if other.rate_of == state:
            return column
    raise ModelError(f"No state is the rate of {state}; a force acts on a state that has one.")


def _rated(channel: Channel) -> float:
    """Returns a typical size of a channel: its bound, or one."""
    bound = max(abs(channel.lower), abs(channel.upper))
    return bound if 0.0 < bound < float("inf") else 1.0
