"""The number of simulated trajectories that are held in memory at once."""

from collections.abc import Iterator, Mapping

from torch import Tensor

from npdr_ppl.language.prior import Prior
from npdr_ppl.memory import release_freed_memory
from npdr_ppl.preparation.sampling_settings import DRAW_BUDGET

__all__ = ["affordable_draws", "executed_in_parts"]


BYTES = 8
"""Bytes of a reading in double precision, in which most is computed."""


def affordable_draws(
    wanted: int, num_readings: int, *, budget: int = DRAW_BUDGET.most_bytes
) -> int:
    """Returns the number of draws of a trajectory to keep: all, if memory allows it.

    Args:
        wanted: Number of draws if the recording is short.
        num_readings: Readings of one draw.
        budget: Bytes that the draws may take.
    """
    return min(wanted, max(DRAW_BUDGET.least_draws, budget // (BYTES * max(1, num_readings))))


def executed_in_parts(
    prior: Prior, z: Tensor, num_readings: int
) -> Iterator[tuple[Tensor, Mapping[str, Tensor]]]:
    """Simulates a program at many points, a part of them at a time to bound memory.

    Random numbers come from torch's global stream, part after part.

    Args:
        prior: The program.
        z: Points, ``(n, d)``.
        num_readings: Readings of one simulation.

    Yields:
        Points and the sites' outputs at them.
    """
    release_freed_memory()
    for part in z.split(max(1, DRAW_BUDGET.measurements_per_part // max(1, num_readings))):
        yield part, prior.execute(part)
    release_freed_memory()
