"""Draws of parameters of any shape as columns of numbers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["scalar_columns"]


def scalar_columns(parameters: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """Returns one column ``(n,)`` per scalar parameter; elements of vectors are ``name[i]``.

    Args:
        parameters: Draws ``(n, ...)`` by name, as tensors on the CPU or arrays.
    """
    columns: dict[str, NDArray[np.float64]] = {}
    for name, value in parameters.items():
        flat = np.asarray(value, dtype=float).reshape(len(value), -1)
        if flat.shape[1] == 1:
            columns[name] = flat[:, 0]
        else:
            columns |= {f"{name}[{i}]": flat[:, i] for i in range(flat.shape[1])}
    return columns
