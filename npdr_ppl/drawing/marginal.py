"""One marginal density of a posterior, with the prior's density behind it."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.drawing.theme import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["density", "draw_marginal"]


def draw_marginal(
    axis: "Axes", posterior: NDArray[np.float64], prior: NDArray[np.float64] | None = None
) -> None:
    """Draws one marginal density, with the prior's density in grey behind it."""
    together = posterior if prior is None else np.concatenate([posterior, prior])
    low, high = together.min(), together.max()
    grid = np.linspace(low, high, 200)
    if prior is not None and prior.std() > 0:
        axis.fill_between(grid, density(prior, grid), color=COLORS["prior"], alpha=0.4, lw=0,
                          label="prior")  # fmt: skip
    if posterior.std() > 0:
        axis.plot(grid, density(posterior, grid), color=COLORS["posterior"], label="posterior")
        axis.fill_between(grid, density(posterior, grid), color=COLORS["posterior"], alpha=0.2)
    axis.set_xlim(low, high)
    axis.set_ylim(bottom=0)
    axis.set_yticks([])
    axis.ticklabel_format(axis="x", scilimits=(-2, 3))


def density(samples: NDArray[np.float64], grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a kernel density, reflected at the samples' ends so that edges stay sharp."""
    from scipy.stats import gaussian_kde

    low, high = samples.min(), samples.max()
    kernel = gaussian_kde(samples)
    values = kernel(grid) + kernel(2 * low - grid) + kernel(2 * high - grid)
    return np.where((grid >= low) & (grid <= high), values, 0.0)
