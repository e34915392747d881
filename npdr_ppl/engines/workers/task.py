"""Tasks of workers: a task is set up once and then runs one draw after another."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from npdr_ppl.randomness import derived_seed

__all__ = ["Draw", "Task"]


@dataclass(frozen=True)
class Draw:
    """One simulation to run.

    Attributes:
        index: Position in the run.
        payload: Input of the simulation.
        run_seed: Seed of the run.
        attempt: How often the draw has failed before.
    """

    index: int
    payload: Any
    run_seed: int
    attempt: int = 0

    @property
    def seed(self) -> int:
        """Seed of this draw; the same on every worker and in every attempt."""
        return derived_seed(self.run_seed, "draw", self.index)


class Task(ABC):
    """A function of draws with a set-up; it is pickled by cloudpickle and sent to workers."""

    def set_up(self) -> Any:
        """Returns an object that draws of one process share, e.g. a connection to an engine.

        It is called once in each process, also in a process that replaces another.
        """
        return None

    @abstractmethod
    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Returns the draw's result, which depends on the draw alone.

        Args:
            workspace: The result of :meth:`set_up`.
            draw: The draw.

        Raises:
            NpdrError: The task itself is wrong, so no draw can succeed. Any other exception makes
                only this draw fail.
        """
