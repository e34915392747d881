"""Conversion of user input to the float64 arrays of recordings."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from npdr_ppl.errors import DataError

__all__ = ["Array", "as_arrays", "frozen"]

Array = NDArray[np.float64]


def frozen(values: ArrayLike) -> Array:
    """Returns a read-only float64 copy."""
    copied = np.array(values, dtype=np.float64)
    copied.flags.writeable = False
    return copied


def as_arrays(values: Any, name: str) -> tuple[Array, ...]:
    """Returns one float64 array per rollout.

    Args:
        values: A stacked array, or a sequence of arrays or tensors.
        name: Their name, for messages.

    Raises:
        DataError: The values are not numbers.
    """
    try:
        return tuple(
            np.asarray(v.detach().cpu() if isinstance(v, Tensor) else v, dtype=np.float64)
            for v in values
        )
    except (TypeError, ValueError):
        raise DataError(f"{name} should be one array of numbers per rollout.") from None
