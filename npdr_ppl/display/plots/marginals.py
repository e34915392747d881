"""Marginals of the posterior against the prior, one panel per parameter."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from npdr_ppl.drawing.marginal import density, draw_marginal
from npdr_ppl.drawing.theme import COLORS, theme

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
    """Adds one legend with the entries of all axes of the figure."""
    entries: dict[str, Any] = {}
    for axis in figure.axes:
        handles, labels = axis.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(list(entries.values()), list(entries), **placement)
