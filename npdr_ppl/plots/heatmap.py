"""Posterior over rounds as heat maps, as in Figure 2 of Muratore et al. (2021)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from npdr_ppl.plots.marginals import Samples
from npdr_ppl.plots.theme import COLORS, theme

__all__ = ["plot_rounds"]

BINS = 80


def plot_rounds(
    rounds: Mapping[str, Samples],
    x: str,
    y: str,
    *,
    ranges: tuple[tuple[float, float], tuple[float, float]],
    truth: Mapping[str, float] | None = None,
    curve: NDArray[np.float64] | None = None,
    units: Sequence[str] = ("", ""),
) -> Figure:
    """Draws the joint posterior of two parameters after several rounds, side by side.

    Args:
        rounds: Draws by title of the panel and by parameter.
        x: Parameter on the horizontal axis.
        y: Parameter on the vertical axis.
        ranges: Limits of both axes.
        truth: True values, marked with a cross.
        curve: Points ``(k, 2)`` of a known ridge, drawn as a line.
        units: Units of both parameters.
    """
    with theme():
        figure = Figure(figsize=(2.5 * len(rounds) + 0.4, 2.7), layout="constrained")
        axes = figure.subplots(1, len(rounds), sharey=True, squeeze=False).ravel()
        for axis, (title, samples) in zip(axes, rounds.items(), strict=True):
            density, edges_x, edges_y = np.histogram2d(
                samples[x], samples[y], bins=BINS, range=ranges, density=True
            )
            axis.pcolormesh(edges_x, edges_y, density.T, cmap="magma_r", rasterized=True)
            if curve is not None:
                axis.plot(curve[:, 0], curve[:, 1], color=COLORS["most likely"], lw=0.8)
            if truth:
                axis.plot(truth[x], truth[y], "+", color=COLORS["truth"], ms=9, mew=2)
            axis.set_xlim(*ranges[0])
            axis.set_ylim(*ranges[1])
            axis.set_title(title)
            axis.set_xlabel(f"{x} [{units[0]}]" if units[0] else x)
        axes[0].set_ylabel(f"{y} [{units[1]}]" if units[1] else y)
    return figure
