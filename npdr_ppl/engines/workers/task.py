"""What a worker does: one draw after the other, with what it has set up once."""

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
        payload: What to simulate.
        run_seed: Seed of the run.
        attempt: How often the draw has failed before.
    """

    index: int
    payload: Any
    run_seed: int
    attempt: int = 0

    @property
    def seed(self) -> int:
        """Seed of this draw, wherever and however often it runs."""
        return derived_seed(self.run_seed, "draw", self.index)


class Task(ABC):
    """A function of draws with a set-up of its own; pickled by cloudpickle and sent to workers."""

    def set_up(self) -> Any:
        """Returns what draws share within one process, e.g. a connection to an engine.

        It is called anew in each process, also in one that takes the place of another.
        """
        return None

    @abstractmethod
    def run(self, workspace: Any, draw: Draw) -> np.ndarray:
        """Returns the draw's result, which depends on the draw alone.

        Args:
            workspace: What :meth:`set_up` returned.
            draw: The draw.

        Raises:
            NpdrError: The task itself is wrong, so that no draw can succeed; any other exception
                costs this draw only.
        """
