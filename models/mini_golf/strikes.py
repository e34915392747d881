"""Strikes by the batch: draws in, trajectories out."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from npdr_ppl.models.mini_golf.course import StrikeParameters
from npdr_ppl.models.mini_golf.kinematics import head_path
from npdr_ppl.models.mini_golf.scene import SUB_STEPS, HeadPath, Scene

__all__ = ["Swing", "run_strikes"]

Array = NDArray[np.float64]

STRIKES_PER_TASK = 16
"""A quarter of a second of work, against some milliseconds for handing it over."""


@dataclass(frozen=True)
class Swing:
    """What is the same for all draws of one recorded strike.

    Attributes:
        angles: Joint angles at the bounds of steps in rad, ``(K + 1, 7)``; between them they are
            linear in time.
        ball: Where the ball lies at the start in m, ``(2,)``.
        time_step: Seconds per step.
    """

    angles: Array
    ball: Array
    time_step: float

    def head(self) -> HeadPath:
        """Returns the club head's path."""
        num_steps = len(self.angles) - 1
        time = np.arange(num_steps * SUB_STEPS + 1) / SUB_STEPS
        angles = [np.interp(time, np.arange(num_steps + 1), joint) for joint in self.angles.T]
        return HeadPath.of(head_path(np.stack(angles, axis=-1)), self.time_step / SUB_STEPS)


def run_strikes(swing: Swing, draws: Sequence[StrikeParameters], num_workers: int) -> Array:
    """Simulates one strike per draw.

    Args:
        swing: The arm's motion and the ball's place.
        draws: Parameters of n strikes.
        num_workers: Processes to simulate in; 1 for this one.

    Returns:
        The ball's x and y after each step in m, ``(n, K, 2)``.
    """
    if num_workers == 1 or len(draws) <= STRIKES_PER_TASK:
        return _run(swing, draws)
    parts = [draws[i : i + STRIKES_PER_TASK] for i in range(0, len(draws), STRIKES_PER_TASK)]
    results = Parallel(n_jobs=min(num_workers, len(parts)))(
        delayed(_run)(swing, part) for part in parts
    )
    return np.concatenate([result for result in results if result is not None])


def available_workers() -> int:
    """Returns the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


def _run(swing: Swing, draws: Sequence[StrikeParameters]) -> Array:
    head = swing.head()
    scene = _scene()
    return np.stack([scene.strike(draw, swing.ball, head, swing.time_step) for draw in draws])


@cache
def _scene() -> Scene:
    """Returns this process' connection to Bullet; opening one takes as long as a strike."""
    return Scene()
