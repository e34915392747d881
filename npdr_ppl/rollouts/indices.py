"""Chooses rollouts: subsets and splits, by rollout and never by sample."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import DataError

__all__ = ["Index", "chosen", "split"]

Index = int | slice | Sequence[int] | NDArray[Any]


def chosen(index: Index, count: int) -> list[int]:
    """Returns the positions that an index chooses out of ``count``.

    Raises:
        DataError: Nothing is chosen, or the index is invalid.
        IndexError: A position does not exist; iteration relies on this error.
    """
    if isinstance(index, int | np.integer):
        positions = [int(index)]
    elif isinstance(index, slice):
        positions = list(range(count))[index]
    else:
        selected = np.asarray(index)
        if selected.size and selected.dtype.kind not in "iub":
            raise DataError(f"rollouts are chosen by integers, not {selected.dtype}.")
        if selected.dtype == bool:
            if selected.shape != (count,):
                raise DataError(f"a mask over {count} rollouts cannot have {selected.shape}.")
            selected = np.flatnonzero(selected)
        positions = [int(i) for i in selected]
    for position in positions:
        if not -count <= position < count:
            raise IndexError(f"there is no rollout {position}; there are {count}.")
    if not positions:
        raise DataError("no rollout was chosen.")
    return positions


def split(
    count: int, train: Sequence[int] | float, test: Sequence[int] | None, seed: int | None
) -> tuple[list[int], list[int]]:
    """Returns the positions of the training and test rollouts; see :meth:`Rollouts.split`."""
    if isinstance(train, int | float):
        if not 0 < train < 1 or count < 2 or test is not None:
            raise DataError(
                "a fractional split needs a fraction between 0 and 1, two rollouts and no "
                f"test indices, got {train=}, {count} rollouts, {test=}."
            )
        order = np.arange(count)
        if seed is not None:
            np.random.default_rng(seed).shuffle(order)
        size = min(max(round(train * count), 1), count - 1)
        return sorted(order[:size].tolist()), sorted(order[size:].tolist())
    left = [i % count for i in chosen(train, count)]
    others = [i for i in range(count) if i not in left] if test is None else test
    right = [i % count for i in chosen(others, count)]
    shared = sorted(set(left) & set(right))
    if shared:
        raise DataError(f"rollout {shared[0]} is on both sides of the split.")
    return left, right
