"""Pair plot: every two parameters' joint posterior, marginals on the diagonal."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from npdr_ppl.display.plots.marginals import Samples, add_legend, draw_marginal
from npdr_ppl.drawing.theme import COLORS, theme

__all__ = ["plot_pair"]

# Levels of a two-dimensional highest-density region: 90 % and 50 % of the draws.
MASSES = (0.9, 0.5)
BINS = 40


def plot_pair(
    posterior: Samples,
    prior: Samples,
    *,
    marks: Mapping[str, Mapping[str, float]] | None = None,
) -> Figure:
    """Draws the joint posterior of every two parameters on the prior's range.

    Args:
        posterior: Draws ``(n,)`` by parameter.
        prior: Draws ``(m,)`` by parameter; they set the axes.
        marks: Points to mark by legend entry and parameter.
    """
    names = list(posterior)
    count = len(names)
    with theme():
        size = max(3.5, 1.35 * count)
        figure = Figure(figsize=(size, size), layout="constrained")
        axes = figure.subplots(count, count, squeeze=False)
        for i, row in enumerate(names):
            for j, column in enumerate(names):
                axis = axes[i, j]
                if j > i:
                    axis.set_visible(False)
                    continue
                if i == j:
                    draw_marginal(axis, posterior[row], prior[row])
                else:
                    _draw_joint(axis, posterior, prior, column, row)
                for label, values in (marks or {}).items():
                    _mark(axis, label, values, column, row if i != j else None)
                axis.tick_params(labelbottom=i == count - 1, labelleft=j == 0 and i > 0)
                for side in (axis.xaxis, axis.yaxis):
                    side.set_major_locator(MaxNLocator(3))
                    side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                if i == j:
                    axis.set_yticks([])
                if i == count - 1:
                    axis.set_xlabel(column, fontsize=7)
                    axis.tick_params(axis="x", rotation=45)
                if j == 0 and i > 0:
                    axis.set_ylabel(row, fontsize=7)
        add_legend(figure, loc="upper right", bbox_to_anchor=(0.97, 0.97))
    return figure


def _draw_joint(axis: Axes, posterior: Samples, prior: Samples, x: str, y: str) -> None:
    # The posterior may reach the edge of the prior's draws or exceed it.
    joint = {name: np.concatenate([prior[name], posterior[name]]) for name in (x, y)}
    bounds = [(values.min(), values.max()) for values in joint.values()]
    density, edges_x, edges_y = np.histogram2d(posterior[x], posterior[y], bins=BINS, range=bounds)
    axis.pcolormesh(edges_x, edges_y, _smooth(density).T, cmap="Blues", rasterized=True)
    levels = _levels(_smooth(density))
    if len(set(levels)) == len(levels):
        centres_x, centres_y = (
            edges_x[:-1] + np.diff(edges_x) / 2,
            edges_y[:-1] + np.diff(edges_y) / 2,
        )
        axis.contour(
            centres_x, centres_y, _smooth(density).T, levels=levels, colors=COLORS["posterior"],
            linewidths=0.8,
        )  # fmt: skip


def _mark(axis: Axes, label: str, values: Mapping[str, float], x: str, y: str | None) -> None:
    color = COLORS.get(label, "k")
    if y is None and x in values:
        axis.axvline(values[x], color=color, lw=1, label=label)
    elif y is not None and x in values and y in values:
        axis.plot(values[x], values[y], "+", color=color, ms=7, mew=1.5)


def _smooth(density: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(density, 1.0)


def _levels(density: NDArray[np.float64]) -> list[float]:
    """Returns the density levels that enclose the masses of :data:`MASSES`, rising."""
    ordered = np.sort(density.ravel())[::-1]
    cumulative = np.cumsum(ordered) / max(ordered.sum(), np.finfo(float).tiny)
    return [float(ordered[np.searchsorted(cumulative, mass)]) for mass in MASSES]
