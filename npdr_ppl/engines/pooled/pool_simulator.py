"""Simulators whose engine runs one simulation at a time, distributed over workers."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.engines.common.signals import Signals, domain_by_segment, needs_accelerations
from npdr_ppl.engines.workers.session import run_on_workers
from npdr_ppl.engines.workers.task import Draw, Task
from npdr_ppl.errors import ModelError, SimulationError
from npdr_ppl.language.effects import Effect, EnvironmentEffect, ForceEffect, SensorEffect
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator

__all__ = ["PooledSimulator", "Segment"]


@dataclass(frozen=True)
class Segment:
    """Inputs of one simulation.

    Attributes:
        initial_state: True state at the start, ``(states,)``, in the states' units.
        actions: Actions that act during each step, ``(steps, actions)``: limited commands after
            all action effects.
        time_step: Seconds per step.
        start_time: Seconds from the start of the rollout to the start of the segment.
    """

    initial_state: np.ndarray
    actions: np.ndarray
    time_step: float
    start_time: float


class PooledSimulator(Simulator):
    """A simulator that receives one segment and one set of parameters at a time.

    A subclass declares channels, parameters and ports, and writes :meth:`simulate_one`. A batch is
    run by the workers of the enclosing :func:`npdr_ppl.workers` block, or by one worker per core.
    A simulation that crashes, hangs, raises an error or returns NaN is run once more. If it fails
    again, its trajectory is NaN.

    Effects on commands, measurements and domain parameters are applied outside the engine. Effects
    on forces and on the environment must be applied by :meth:`simulate_one`, which receives their
    parameters.

    The simulator is sent to workers, so it must be picklable; :meth:`set_up` should open the
    connections to an engine.
    """

    def set_up(self) -> Any:
        """Returns the object that all simulations of a process share; see :class:`Task`."""
        return None

    @abstractmethod
    def simulate_one(
        self, workspace: Any, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> np.ndarray:
        """Simulates one segment.

        The result must not depend on what the process simulated before.

        Args:
            workspace: The result of :meth:`set_up`.
            parameters: All parameters of the simulator, and of effects on forces and on the
                environment, in the declared units.
            segment: The segment.
            seed: Seed of all random numbers.

        Returns:
            True values of the sensors' channels after each step, ``(steps, sensors)``.
        """

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions; see :meth:`Simulator.simulate`."""
        self.check_parameters(parameters)
        self.check_inputs(inputs)
        with torch.no_grad():
            return _simulate(self, parameters, inputs)

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy with effects attached; see :meth:`Simulator.with_effects`.

        Raises:
            ModelError: A sensor effect needs accelerations, which the engine does not provide.
        """
        changed = super().with_effects(*effects)
        for effect in effects:
            if isinstance(effect, SensorEffect) and needs_accelerations(effect):
                raise ModelError(
                    f"{effect.id} cannot attach to {effect.port!r} of {self.name}: it needs "
                    "accelerations at a segment's start, which the engine does not give."
                )
        return changed

    @property
    def inner_effects(self) -> tuple[ForceEffect | EnvironmentEffect, ...]:
        """The attached effects that :meth:`simulate_one` must apply."""
        return tuple(e for e in self.effects if isinstance(e, ForceEffect | EnvironmentEffect))


@dataclass(frozen=True)
class _OneSimulation:
    """The data that differ between the draws of a call.

    Attributes:
        parameters: Values in the order of the task's names, ``(parameters,)``.
        initial_state: True state at the start, ``(states,)``.
        segment: Row of the task's table of actions.
        start_time: Seconds from the rollout's beginning to the segment's start.
        num_steps: Number of steps without padding.
        actions: The actions themselves, if draws do not share them.
    """

    parameters: np.ndarray
    initial_state: np.ndarray
    segment: int
    start_time: float
    num_steps: int
    actions: np.ndarray | None = None


@dataclass(frozen=True)
class _Simulate(Task):
    """Runs a simulator's simulations.

    Attributes:
        simulator: The simulator.
        names: Names of the parameters.
        actions: Actions of each segment, ``(segments, steps, actions)``.
        time_step: Seconds per step.
    """

    simulator: PooledSimulator
    names: tuple[str, ...]
    actions: np.ndarray
    time_step: float

    def set_up(self) -> Any:
        """Returns the simulator's workspace."""
        return self.simulator.set_up()

    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Returns the trajectory, ``(steps, sensors)``."""
        one: _OneSimulation = draw.payload
        actions = self.actions[one.segment] if one.actions is None else one.actions
        segment = Segment(
            one.initial_state, actions[: one.num_steps], self.time_step, one.start_time
        )
        parameters = dict(zip(self.names, one.parameters.tolist(), strict=True))
        result = self.simulator.simulate_one(workspace, parameters, segment, draw.seed)
        expected = (one.num_steps, len(self.simulator.sensors))
        if np.shape(result) != expected:
            raise SimulationError(
                f"{self.simulator.name}.simulate_one returned an array of shape "
                f"{np.shape(result)}; expected {expected}."
            )
        return result


def _simulate(
    simulator: PooledSimulator, parameters: Mapping[str, Tensor], inputs: Inputs
) -> Tensor:
    """Returns the measurements of all parameters, segments and steps."""
    dtype, device = inputs.actions.dtype, inputs.actions.device
    for value in parameters.values():
        if value.is_floating_point():
            dtype = torch.promote_types(dtype, value.dtype)
    inputs = inputs.to(dtype=torch.float64, device="cpu")
    domain, shape = domain_by_segment(simulator, parameters, inputs)
    signals = Signals(simulator, domain, inputs, shape)
    initial_states = signals.initial_states()
    task, payloads = _task_and_payloads(simulator, domain, inputs, shape, signals, initial_states)
    seed = 0 if simulator.is_deterministic else int(torch.randint(2**62, ()))
    outcome = run_on_workers(task, payloads, seed)
    values = np.zeros((shape.numel(), inputs.num_steps, len(simulator.sensors)))
    for row, value, payload in zip(values, outcome.values, payloads, strict=True):
        row[: payload.num_steps] = np.nan if value is None else value
    readings = signals.readings(torch.from_numpy(values), initial_states)
    readings = readings.reshape(*shape, *readings.shape[1:])
    readings = torch.where(inputs.mask[..., None], readings, torch.zeros_like(readings))
    return readings.to(dtype=dtype, device=device)


def _task_and_payloads(
    simulator: PooledSimulator,
    domain: Mapping[str, Tensor],
    inputs: Inputs,
    shape: torch.Size,
    signals: Signals,
    initial_states: Tensor,
) -> tuple[_Simulate, list[_OneSimulation]]:
    """Splits a call into data that all simulations share and data of each simulation."""
    inner = {name for effect in simulator.inner_effects for name in effect.parameter_names}
    names = tuple(p.name for p in simulator.parameters) + tuple(sorted(inner))
    matrix = torch.zeros(shape.numel(), len(names), dtype=torch.float64)
    for column, name in enumerate(names):
        matrix[:, column] = domain[name].expand(shape).reshape(-1)
    num_steps = inputs.mask.long().sum(-1).expand(shape).reshape(-1).tolist()
    times = signals.start_times.tolist()
    own = signals.actions().numpy() if signals.has_action_effects else None
    table = _limited_actions(simulator, inputs).numpy()
    segments = torch.arange(len(table)).reshape((*inputs.batch_shape, inputs.num_segments))
    rows = segments.expand(shape).reshape(-1).tolist()
    payloads = [
        _OneSimulation(values, state, row, time, steps, None if own is None else own[index])
        for index, (values, state, row, time, steps) in enumerate(
            zip(matrix.numpy(), initial_states.numpy(), rows, times, num_steps, strict=True)
        )
    ]
    if own is not None:
        table = table[:0]
    return _Simulate(simulator, names, table, inputs.time_step), payloads


def _limited_actions(simulator: Simulator, inputs: Inputs) -> Tensor:
    """Returns commands within the channels' limits, ``(inputs' batch and segments, K, A)``."""
    columns = [inputs.action_names.index(action.name) for action in simulator.actions]
    actions = inputs.actions[..., columns]
    lower = actions.new_tensor([action.lower for action in simulator.actions])
    upper = actions.new_tensor([action.upper for action in simulator.actions])
    return actions.clamp(lower, upper).flatten(0, -3)
