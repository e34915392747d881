"""Posterior over rounds as heat maps, as in Figure 2 of Muratore et al. (2021)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from npdr_ppl.display.plots.marginals import Samples
from npdr_ppl.drawing.theme import COLORS, theme

__all__ = ["plot_heatmaps"]

BINS = 80


def plot_heatmaps(
    rows: Mapping[str, Mapping[str, Samples]],
    x: str,
    y: str,
    *,
    ranges: tuple[tuple[float, float], tuple[float, float]],
    truth: Mapping[str, float] | None = None,
    curve: NDArray[np.float64] | None = None,
    units: Sequence[str] = ("", ""),
    smoothing: float = 0.0,
) -> Figure:
    """Draws the joint posterior of two parameters, a row of panels for each method.

    Args:
        rows: Draws by title of the row, title of the panel and parameter.
        x: Parameter on the horizontal axis.
        y: Parameter on the vertical axis.
        ranges: Limits of both axes.
        truth: Values to mark with a cross.
        curve: Points ``(k, 2)`` of a known ridge, drawn as a line.
        units: Units of both parameters.
        smoothing: Standard deviation of a Gaussian filter, in bins.
    """
    columns = max(len(panels) for panels in rows.values())
    with theme():
        size = (2.5 * columns + 0.4, 2.3 * len(rows) + 0.4)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(rows), columns, sharex=True, sharey=True, squeeze=False)
        for line, (name, panels) in zip(axes, rows.items(), strict=True):
            for axis, (title, samples) in zip(line, panels.items(), strict=False):
                density, edges_x, edges_y = np.histogram2d(
                    samples[x], samples[y], bins=BINS, range=ranges, density=True
                )
                density = gaussian_filter(density, smoothing)
                axis.pcolormesh(edges_x, edges_y, density.T, cmap="magma_r", rasterized=True)
                if curve is not None:
                    axis.plot(curve[:, 0], curve[:, 1], color=COLORS["most likely"], lw=0.8)
                if truth:
                    axis.plot(truth[x], truth[y], "+", color=COLORS["truth"], ms=9, mew=2)
                axis.set_xlim(*ranges[0])
                axis.set_ylim(*ranges[1])
                axis.set_title(title)
                axis.ticklabel_format(scilimits=(-2, 3))
            for axis in line[len(panels) :]:
                axis.set_visible(False)
            label = f"{y} [{units[1]}]" if units[1] else y
            line[0].set_ylabel(f"{name}\n{label}" if name.strip() else label)
        for axis, below in zip(axes.T.ravel(), [*axes.T.ravel()[1:], None], strict=True):
            is_last = below is None or axis in axes[-1] or not below.get_visible()
            if is_last and axis.get_visible():
                axis.set_xlabel(f"{x} [{units[0]}]" if units[0] else x)
                axis.tick_params(labelbottom=True)
    return figure
