"""Marginals of the posterior against the prior, one panel per parameter."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import gaussian_kde

from npdr_ppl.plots.theme import COLORS, theme

__all__ = ["add_legend", "density", "draw_marginal", "plot_marginals"]

Samples = Mapping[str, NDArray[np.float64]]
MAX_COLUMNS = 4


def plot_marginals(
    posterior: Samples,
    prior: Samples,
    *,
    marks: Mapping[str, Mapping[str, float]] | None = None,
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Draws every parameter's marginal posterior over its prior.

    Args:
        posterior: Draws ``(n,)`` by parameter.
        prior: Draws ``(m,)`` by parameter.
        marks: Values to mark by legend entry and parameter, e.g. ``{"nominal": {"mass": 1.0}}``.
        units: Units by parameter.
    """
    names = list(posterior)
    columns = min(MAX_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    with theme():
        figure = Figure(figsize=(2.6 * columns, 1.9 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis, name in zip(axes, names, strict=False):
            draw_marginal(axis, posterior[name], prior[name])
            for label, values in (marks or {}).items():
                if name in values:
                    axis.axvline(values[name], color=COLORS.get(label, "k"), lw=1.2, label=label)
            unit = (units or {}).get(name, "")
            axis.set_xlabel(f"{name} [{unit}]" if unit and unit != "1" else name)
        for axis in axes[len(names) :]:
            axis.set_visible(False)
        add_legend(figure, loc="outside upper center", ncols=4)
    return figure


def add_legend(figure: Figure, **placement: Any) -> None:
    """Adds one legend with every entry that any of the figure's axes has."""
    entries: dict[str, Any] = {}
    for axis in figure.axes:
        handles, labels = axis.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(list(entries.values()), list(entries), **placement)


def draw_marginal(
    axis: Axes, posterior: NDArray[np.float64], prior: NDArray[np.float64] | None = None
) -> None:
    """Draws one marginal density, the prior's in grey behind it."""
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
    """Returns a kernel density, reflected at the samples' ends so that edges stay visible."""
    low, high = samples.min(), samples.max()
    kernel = gaussian_kde(samples)
    values = kernel(grid) + kernel(2 * low - grid) + kernel(2 * high - grid)
    return np.where((grid >= low) & (grid <= high), values, 0.0)
