"""One measurement of ``gpu.py``: its row, its times, and what it is compared with."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

__all__ = ["NUM_STEPS", "Row", "largest_difference", "moment_difference", "speed_up", "timed"]

LEAST_SECONDS = 1.0
"""Calls are repeated until they have taken this many seconds in all. One that takes longer is
measured once."""

NUM_STEPS = 100
"""Steps of a replayed segment, as in a fit that re-synchronises the state every 0.2 s at 2 ms."""

BLOCK = 100_000
"""Simulations whose results are compared at a time."""


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        part: Part of the benchmark.
        case: What was computed.
        size: Number of simulations.
        where: Processor and engine.
        seconds: Seconds of a call, or ``None`` if it was not measured.
        first_seconds: Seconds of the first call, which includes compilation.
        steps: Simulated steps of a call; ``None`` for training.
        difference: Largest difference from the first row of the same case and size: in standard
            deviations of the posterior for training, otherwise in the sensors' units.
        note: What else there is to say, such as why there is no measurement.
    """

    part: str
    case: str
    size: int
    where: str
    seconds: float | None = None
    first_seconds: float | None = None
    steps: int | None = None
    difference: float | None = None
    note: str = ""


def speed_up(row: Row, rows: list[Row]) -> float | None:
    """Returns how many times faster a row is than the first of the same case and size."""
    key = row.part, row.case, row.size
    first = next(r for r in rows if (r.part, r.case, r.size) == key)
    if row.seconds is None or first.seconds is None:
        return None
    return first.seconds / row.seconds


def moment_difference(reference: Tensor, draws: Tensor) -> float:
    """Returns the largest difference of means and standard deviations, in standard deviations.

    Args:
        reference: Draws of one posterior, ``(n, d)``.
        draws: Draws of the other, ``(n, d)``.
    """
    scale = reference.std(0)
    means = (draws.mean(0) - reference.mean(0)).abs() / scale
    return float(torch.maximum(means, (draws.std(0) / scale - 1.0).abs()).max())


def largest_difference(reference: Any, other: Any) -> float:
    """Returns the largest difference of two arrays of equal shape; NaN if one of them has a NaN.

    Compares a block of simulations at a time, so that it needs little memory.
    """

    def block(values: Any, first: int) -> Tensor:
        return torch.as_tensor(values[first : first + BLOCK]).double().cpu()

    firsts = range(0, len(reference), BLOCK)
    largest = [(block(reference, i) - block(other, i)).abs().max() for i in firsts]
    return float(torch.stack(largest).max())


def timed(run: Callable[[], Any]) -> tuple[Any, float, float]:
    """Returns the result, the seconds of the first call and the median of the calls after it.

    Args:
        run: Function that returns when its result is there.
    """
    start = time.perf_counter()
    result = run()
    first, seconds = time.perf_counter() - start, []
    while sum(seconds) < LEAST_SECONDS:
        del result
        start = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - start)
    return result, first, statistics.median(seconds)
