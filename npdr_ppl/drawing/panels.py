"""Panels for `plot()`: the caller's axes, or a new figure that a notebook shows."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.drawing.theme import theme
from npdr_ppl.errors import ShapeError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["panels"]


def panels(
    axes: "NDArray[Any] | Axes | None", count: int, *, columns: int, size: tuple[float, float]
) -> NDArray[Any]:
    """Returns axes to draw on, ``(count,)``.

    Args:
        axes: The caller's axes, one per panel; ``None`` makes a new figure, which pyplot manages,
            so that notebooks show it.
        count: Number of panels.
        columns: Panels in a row of a new figure.
        size: Width and height of a panel of a new figure, inches.

    Raises:
        ShapeError: The number of the caller's axes is not ``count``.
    """
    if axes is not None:
        given = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
        if len(given) != count:
            raise ShapeError(f"There are {count} panels to draw; got {len(given)} axes.")
        return given
    import matplotlib.pyplot as plt

    width = min(columns, count)
    height = -(-count // width)
    with theme():
        _, made = plt.subplots(
            height,
            width,
            squeeze=False,
            figsize=(size[0] * width, size[1] * height),
            layout="constrained",
        )
    for unused in made.ravel()[count:]:
        unused.set_visible(False)
    return made.ravel()[:count]
