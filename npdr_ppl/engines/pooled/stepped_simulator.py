"""Simulators on workers that can be advanced step by step, and policies that run in them."""

import copy
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.chain_state import Moments, State, Tables
from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.engines.common.effect_chain import EffectChain, needed_histories
from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.policy_loop import LoopBody, begin
from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator, Segment
from npdr_ppl.engines.workers.session import run_on_workers
from npdr_ppl.engines.workers.task import Draw, Task
from npdr_ppl.errors import ModelError
from npdr_ppl.language.effects import ActionEffect, SensorEffect

__all__ = ["Simulation", "SteppedSimulator"]

_ONE = torch.Size((1,))


class Simulation(Protocol):
    """One running simulation."""

    def read(self) -> Sequence[float] | np.ndarray:
        """Returns the present true values of the sensors' channels, ``(sensors,)``."""
        ...

    def advance(self, step: int, /) -> None:
        """Performs a step with ``segment.actions[step]``; steps are called in order, from 0."""
        ...


class SteppedSimulator(PooledSimulator, ClosedLoopSimulator):
    """A simulator that receives one segment at a time and can stop after each step.

    A subclass writes :meth:`begin` instead of :meth:`simulate_one`. In closed loop, every episode
    is one draw; the worker evaluates policy, reward and effects. The return of an episode that
    finally failed is NaN, and its length is 0. All states must be among the sensors, because
    reward and bounds need them.
    """

    @abstractmethod
    def begin(
        self, workspace: Any, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> Simulation:
        """Begins a simulation; see :meth:`PooledSimulator.simulate_one` for the arguments.

        In closed loop, row k of ``segment.actions`` is set directly before step k.
        """

    def simulate_one(
        self, workspace: Any, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> np.ndarray:
        """Simulates one segment; see :meth:`PooledSimulator.simulate_one`."""
        simulation = self.begin(workspace, parameters, segment, seed)
        advance, read = simulation.advance, simulation.read
        num_steps = len(segment.actions)
        readings = []
        for step in range(num_steps):
            advance(step)
            readings.append(read())
        return np.array(readings, dtype=np.float64).reshape(num_steps, len(self.sensors))

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`roll_out`.

        The arguments for compilation have no effect.

        Raises:
            ModelError: A state is not among the sensors.
        """
        sensors = [sensor.name for sensor in self.sensors]
        hidden = [state.name for state in self.states if state.name not in sensors]
        if hidden:
            raise ModelError(
                f"{self.name} cannot run policies: reward and bounds look at its states, but "
                f"there is no sensor of {', '.join(hidden)}."
            )
        policy, domain, shape = request.batch(self, torch.float64, torch.device("cpu"))

        def rows(values: Tensor) -> np.ndarray:
            values = values.detach().to(device="cpu", dtype=torch.float64)
            width = values.shape[-1]
            return values.expand(*shape, width).reshape(shape.numel(), width).numpy()

        table = torch.zeros(*shape, len(domain), dtype=torch.float64)
        for column, value in enumerate(domain.values()):
            table[..., column] = value.detach()
        payloads = [
            _OneEpisode(*one)
            for one in zip(
                rows(table), rows(policy.parameters), rows(request.initial_states), strict=True
            )
        ]
        # Data that differ between episodes must not be sent with each chunk.
        policy.parameters = policy.parameters.new_zeros(policy.parameters.shape[-1])
        shared = replace(request, parameters={}, policy=policy, initial_states=torch.zeros(0))
        seed = 0 if self.is_deterministic else int(torch.randint(2**62, ()))
        outcome = run_on_workers(_RunEpisode(self, tuple(domain), shared), payloads, seed)
        return _collected(self, outcome.values, request, shape)


@dataclass(frozen=True)
class _OneEpisode:
    """The data that differ between the episodes of a call.

    Attributes:
        parameters: Values in the order of the task's names, ``(parameters,)``.
        policy: Parameters of the policy.
        initial_state: True state at the start, ``(states,)``.
    """

    parameters: np.ndarray
    policy: np.ndarray
    initial_state: np.ndarray


@dataclass(frozen=True)
class _RunEpisode(Task):
    """Runs a policy in a simulator.

    Attributes:
        simulator: The simulator.
        names: Names of all parameters, including those of effects.
        request: The request, without the data that differ between episodes.
    """

    simulator: SteppedSimulator
    names: tuple[str, ...]
    request: EpisodeRequest

    def set_up(self) -> Any:
        """Returns the simulator's workspace."""
        return self.simulator.set_up()

    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Returns return and length, then measurements and commands if they are recorded."""
        with torch.no_grad():
            return self._run(workspace, draw.payload, draw.seed)

    def _run(self, workspace: Any, one: _OneEpisode, seed: int) -> np.ndarray:
        request, simulator = self.request, self.simulator
        num_steps, time_step = request.num_steps, request.time_step
        values = torch.from_numpy(one.parameters).unbind()
        domain = dict(zip(self.names, values, strict=True))
        middle = torch.tensor(0.5 * num_steps * time_step, dtype=torch.float64)
        present = simulator.changed(domain, middle)
        segment = Segment(
            one.initial_state, np.zeros((num_steps, len(simulator.actions))), time_step, 0.0
        )
        numbers = {name: float(value) for name, value in present.items()}
        simulation = simulator.begin(workspace, numbers, segment, seed)
        stepper = _OneStepper(simulator, simulation, segment, present)
        policy = copy.copy(request.policy)
        policy.parameters = torch.from_numpy(one.policy)
        constants = flatten(policy.constants(request.believed(domain)), _ONE)
        body = LoopBody(stepper, policy, request.reward)
        loop = begin(body, stepper.states(), stepper.tables, constants)
        readings, commands = [loop.readings], []
        for step in range(num_steps):
            loop, chosen = body.step(loop, stepper.tables, constants, step * time_step)
            readings.append(loop.readings)
            commands.append(chosen)
            if not bool(loop.is_running):
                break
        outcome = np.array([float(loop.total), float(loop.length)])
        if not request.record:
            return outcome
        return np.concatenate(
            (
                outcome,
                _padded(readings, num_steps + 1, len(simulator.sensors)),
                _padded(commands, num_steps, len(simulator.actions)),
            )
        )


def _padded(rows: list[Components], num_rows: int, num_columns: int) -> np.ndarray:
    """Returns a flat record of ``num_rows`` rows, padded with zeros after the given rows."""
    table = np.zeros((num_rows, num_columns))
    for row, values in zip(table, rows, strict=False):
        row[:] = [float(value) for value in values]
    return table.reshape(-1)


class _OneStepper(EffectChain):
    """Advances one simulation and applies the effects on its commands and measurements.

    The engine applies effects on forces and on the environment.

    Args:
        simulator: The system and its effects.
        simulation: The simulation, at its start.
        segment: The segment from which the simulation takes its actions.
        parameters: All parameters, as numbers.

    Attributes:
        tables: The effects' parameters.
    """

    def __init__(
        self,
        simulator: SteppedSimulator,
        simulation: Simulation,
        segment: Segment,
        parameters: Mapping[str, Tensor],
    ) -> None:
        part = copy.copy(simulator)
        part.effects = tuple(
            e for e in simulator.effects if isinstance(e, ActionEffect | SensorEffect)
        )
        # Positions come first, in the order of a reward's arguments.
        rates = simulator.is_rate
        order = sorted(range(len(rates)), key=lambda column: rates[column])
        part.states = tuple(simulator.states[column] for column in order)
        own = tuple(effect.own_parameters(parameters) for effect in part.effects)
        histories = needed_histories(part.effects, own, segment.time_step)
        super().__init__(part, (), segment.time_step, histories)
        self.tables = Tables(None, flatten(own, _ONE, expand=True))
        sensors = [sensor.name for sensor in part.sensors]
        self._columns = [sensors.index(state.name) for state in part.states]
        self._simulation, self._segment = simulation, segment
        self._step = 0
        values = list(self._read())
        # An engine may return a rounded or outdated state directly after the state was set.
        for column, value in zip(self._columns, segment.initial_state[order], strict=True):
            values[column] = torch.full(_ONE, float(value), dtype=torch.float64)
        self._values: Components = tuple(values)

    @property
    def num_positions(self) -> int:
        """Number of states that are positions."""
        return sum(not is_rate for is_rate in self.simulator.is_rate)

    def states(self) -> Components:
        """Returns the present state, positions first, ``(1,)`` each."""
        return tuple(self._values[column] for column in self._columns)

    def true_readings(
        self, positions: Components, velocities: Components, tables: Tables
    ) -> Components:
        """Returns the true value of every sensor channel."""
        return self._values

    def move(
        self, state: State, actions: Components, tables: Tables, moments: Moments = ()
    ) -> State:
        """Advances the simulation by one step."""
        self._segment.actions[self._step] = [float(action) for action in actions]
        self._simulation.advance(self._step)
        self._step += 1
        self._values = self._read()
        present, split = self.states(), self.num_positions
        return state._replace(positions=present[:split], velocities=present[split:])

    def _read(self) -> Components:
        values = torch.as_tensor(np.asarray(self._simulation.read(), dtype=np.float64))
        return tuple(values[:, None].unbind())


def _collected(
    simulator: SteppedSimulator,
    values: list[np.ndarray | None],
    request: EpisodeRequest,
    shape: torch.Size,
) -> Episodes:
    """Returns the workers' results in the batch's shape; the return of a lost episode is NaN."""
    num_readings = (request.num_steps + 1) * len(simulator.sensors)
    num_commands = request.num_steps * len(simulator.actions)
    width = 2 + (num_readings + num_commands if request.record else 0)
    lost = np.zeros(width)
    lost[0] = np.nan
    table = torch.from_numpy(np.stack([lost if value is None else value for value in values]))
    returns = None if request.reward is None else table[:, 0].reshape(shape)
    lengths = table[:, 1].long().reshape(shape)
    if not request.record:
        return Episodes(returns, lengths)
    readings, commands = table[:, 2:].split((num_readings, num_commands), dim=-1)
    return Episodes(
        returns,
        lengths,
        readings.reshape(*shape, request.num_steps + 1, len(simulator.sensors)),
        commands.reshape(*shape, request.num_steps, len(simulator.actions)),
    )
