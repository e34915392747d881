"""Channels from which jumps were removed: wrapped angles, and quaternions that change their sign.

A jump is removed from the measurements. Readings between these are interpolated anew around it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.container import Rollouts
from npdr_ppl.rollouts.notes import Remark
from npdr_ppl.rollouts.sampling import Sampling

__all__ = ["joined", "nearest_of", "rewritten"]

INTERPOLATED_NEARBY = 3
"""Number of measurements on either side of a jump around which readings are interpolated anew: a
reading between measurements depends on three of them on either side."""


def rewritten(
    rollouts: Rollouts, made: Sequence[tuple[Array, Sampling]], remark: Remark
) -> Rollouts:
    """Returns rollouts with other readings and measurements, and a remark about them.

    Args:
        rollouts: The rollouts.
        made: Readings and measurements of each.
        remark: What was changed.
    """
    return replace(
        rollouts,
        readings=tuple(readings for readings, _ in made),
        samplings=tuple(sampling for _, sampling in made) if rollouts.samplings else (),
        notes=(*rollouts.notes, remark),
    )


def nearest_of(place: Array, num_rows: int) -> NDArray[np.int64]:
    """Returns the measurement nearest to each row, ``(R,)``.

    Args:
        place: Times of the measurements in steps, increasing, ``(M,)``.
        num_rows: Number of rows R.
    """
    return np.searchsorted(0.5 * (place[1:] + place[:-1]), np.arange(num_rows))


def joined(at_rows: Array, place: Array, measured: Array, is_jump: NDArray[np.bool_]) -> Array:
    """Returns a channel at each row, interpolated anew around jumps that were removed.

    Args:
        at_rows: The channel without the jumps, ``(R,)``.
        place: Times of the measurements in steps, increasing, ``(M,)``.
        measured: The measurements without the jumps, ``(M,)``.
        is_jump: Whether there was one after each measurement but the last, ``(M - 1,)``.
    """
    # Whether each measurement is one of those around a jump.
    kernel = np.ones(2 * INTERPOLATED_NEARBY)
    is_around = np.convolve(is_jump, kernel)[INTERPOLATED_NEARBY - 1 :][: len(measured)] > 0.0
    is_near = is_around[nearest_of(place, len(at_rows))]
    return np.where(is_near, np.interp(np.arange(len(at_rows)), place, measured), at_rows)
