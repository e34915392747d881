"""Simulators on workers that can be advanced step by step."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from npdr_ppl.engines.common.closed_loop_simulator import ClosedLoopSimulator
from npdr_ppl.engines.pooled.pool_simulator import PooledSimulator, Segment

__all__ = ["Simulation", "SteppableSimulator"]


class Simulation(Protocol):
    """One running simulation."""

    def read(self) -> Sequence[float] | np.ndarray:
        """Returns the present true values of the sensors' channels, ``(sensors,)``."""
        ...

    def advance(self, step: int, /) -> None:
        """Performs a step with ``segment.actions[step]``; steps are called in order, from 0."""
        ...


class SteppableSimulator(PooledSimulator, ClosedLoopSimulator):
    """A simulator that receives one segment at a time and can stop after each step."""

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
