"""Posteriors of several backends side by side: marginals, predictive bands, seconds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from npdr_ppl.display.plots.bands import with_breaks
from npdr_ppl.display.plots.marginals import MAX_COLUMNS, Samples, add_legend, density
from npdr_ppl.drawing.theme import COLORS, SERIES, theme

__all__ = ["plot_bands_by_backend", "plot_overlaid_marginals", "plot_seconds"]

STAGES = {"simulate": "#56B4E9", "train": "#0072B2", "sample": "#E69F00"}
"""Stages of a backend, each with the colour of its computing time."""

PEAK_RATIO = 6.0
"""Peaks are cut at this many times the lowest peak, so that broad posteriors stay visible."""

SHARPEST = 1e-6
"""A posterior narrower than this fraction of the axis is drawn as a line."""

LEVELS = (0.05, 0.95, 0.25), (0.25, 0.75, 0.45)
"""Quantiles between which bands lie, and their opacity."""

NUM_POINTS = 300
"""Number of points of a density curve."""

STYLES = ("-", "--", "-.", ":")
"""Line styles; they distinguish the ninth posterior from the first, which has its colour."""


def plot_overlaid_marginals(
    posteriors: Mapping[str, Samples],
    prior: Samples,
    *,
    marks: Mapping[str, Mapping[str, float]] | None = None,
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Draws every parameter's marginal of all posteriors over the prior.

    The figure follows Figure 4 of Muratore et al. (2021).

    Args:
        posteriors: Draws ``(n,)`` by legend entry and parameter.
        prior: Draws ``(m,)`` by parameter; they set the axes.
        marks: Values to mark by legend entry and parameter, e.g. ``{"truth": {"mass": 1.0}}``.
        units: Units by parameter.
    """
    names = list(prior)
    columns = min(MAX_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    with theme():
        figure = Figure(figsize=(2.6 * columns, 1.9 * rows + 0.4), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis, name in zip(axes, names, strict=False):
            together = np.concatenate([prior[name], *[p[name] for p in posteriors.values()]])
            low, high = together.min(), together.max()
            if np.ptp(prior[name]) > 0:
                grid = np.linspace(low, high, NUM_POINTS)
                axis.fill_between(grid, density(prior[name], grid), color=COLORS["prior"],
                                  alpha=0.4, lw=0, label="prior")  # fmt: skip
            peaks = []
            for index, (label, samples) in enumerate(posteriors.items()):
                values = samples[name]
                look: Any = {
                    "color": SERIES[index % len(SERIES)],
                    "ls": STYLES[index // len(SERIES) % len(STYLES)],
                    "label": label,
                }
                if np.ptp(values) <= SHARPEST * (high - low):
                    axis.axvline(values[0], **look)
                    continue
                # Each density has its own grid: a common one could miss a sharp posterior.
                grid = np.linspace(values.min(), values.max(), NUM_POINTS)
                shape = density(values, grid)
                peaks.append(float(shape.max()))
                axis.plot([low, grid[0], *grid, grid[-1], high], [0, 0, *shape, 0, 0], **look)
            for label, values in (marks or {}).items():
                if name in values:
                    axis.axvline(values[name], color="k", lw=1, ls=":", label=label)
            unit = (units or {}).get(name, "")
            axis.set_xlabel(f"{name} [{unit}]" if unit and unit != "1" else name)
            axis.set_xlim(low, high)
            axis.set_ylim(0, 1.05 * min(max(peaks), PEAK_RATIO * min(peaks)) if peaks else None)
            axis.set_yticks([])
            axis.ticklabel_format(axis="x", scilimits=(-2, 3))
        for axis in axes[len(names) :]:
            axis.set_visible(False)
        add_legend(figure, loc="outside upper center", ncols=min(4, len(posteriors) + 1))
    return figure


def plot_bands_by_backend(
    time: NDArray[np.float64],
    measured: NDArray[np.float64],
    predictives: Mapping[str, NDArray[np.float64]],
    *,
    channel_names: Sequence[str],
    units: Sequence[str] = (),
    lines: Mapping[str, NDArray[np.float64]] | None = None,
    resets: NDArray[np.float64] | None = None,
) -> Figure:
    """Draws every posterior's predictive bands over the recording, a column for each.

    The figure follows Figure 5 of Muratore et al. (2021), which shows the recording together with
    simulations with nominal parameters and with draws of a posterior.

    Args:
        time: Seconds, ``(T,)``.
        measured: The recording, ``(T, C)``.
        predictives: Posterior predictive draws, ``(n, T, C)``, by title of the column.
        channel_names: Names of the C channels.
        units: Units of the C channels.
        lines: Simulations ``(T, C)`` by legend entry that every column shows, e.g. nominal.
        resets: Times at which the simulation was re-synchronised.
    """
    channels = measured.shape[-1]
    with theme():
        size = (3.2 * len(predictives) + 0.4, 1.6 * channels + 0.5)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(
            channels, len(predictives), sharex=True, sharey="row", squeeze=False
        )
        for column, (label, predictive) in enumerate(predictives.items()):
            axes[0, column].set_title(label)
            color = SERIES[column % len(SERIES)]
            # Failed simulations are left out: NaN would make the quantiles of all draws NaN.
            whole = predictive[np.isfinite(predictive).all((1, 2))]
            for c, axis in enumerate(axes[:, column]):
                for reset in [] if resets is None else resets:
                    axis.axvline(reset, color="0.9", lw=0.6, zorder=0)
                for low, high, alpha in LEVELS:
                    if not len(whole):
                        continue
                    band = np.quantile(whole[..., c], [low, high], axis=0)
                    shown = with_breaks(time, *band)
                    axis.fill_between(*shown, color=color, alpha=alpha, lw=0)
                if len(whole):
                    # The band of a sharp posterior is too thin to see, so the median is drawn too.
                    middle = np.median(whole[..., c], axis=0)
                    for start, stop in _stretches(time, resets):
                        axis.plot(time[start:stop], middle[start:stop], color=color, lw=0.8)
                for entry, line in (lines or {}).items():
                    # Grey, because the second column has the colour that marks nominal elsewhere.
                    look = {"color": "0.4", "lw": 0.7, "ls": "--"}
                    for start, stop in _stretches(time, resets):
                        axis.plot(time[start:stop], line[start:stop, c], label=entry, **look)
                shown = with_breaks(time, measured[:, c])
                axis.plot(*shown, color=COLORS["measured"], lw=0.8, label="measured")
                if column == 0:
                    unit = units[c] if c < len(units) else ""
                    name = channel_names[c]
                    axis.set_ylabel(f"{name}\n[{unit}]" if unit else name)
            axes[-1, column].set_xlabel("time [s]")
            axes[-1, column].set_xlim(time[0], time[-1])
        for c, row in enumerate(axes):
            # The recording sets the axis limits; bands outside them are cut.
            low, high = measured[:, c].min(), measured[:, c].max()
            margin = 0.25 * (high - low) + np.finfo(float).tiny
            row[0].set_ylim(low - margin, high + margin)
        # Every column has its own colour, so the bands in the legend are black.
        for low, high, alpha in LEVELS:
            label = f"posterior {high - low:.0%}"
            axes[0, 0].add_patch(
                Rectangle((0, 0), 0, 0, color="k", alpha=alpha, lw=0, label=label)
            )
        add_legend(figure, loc="outside upper center", ncols=2 + len(predictives))
    return figure


def _stretches(
    time: NDArray[np.float64], resets: NDArray[np.float64] | None
) -> list[tuple[int, int]]:
    """Returns the index ranges between resets, in which a line is drawn without a gap."""
    starts = [] if resets is None else np.searchsorted(time, resets - 1e-9).tolist()
    bounds = sorted({0, len(time), *starts})
    return list(zip(bounds[:-1], bounds[1:], strict=True))


def plot_seconds(seconds: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draws the computing time of each backend by stage, one bar per backend.

    Args:
        seconds: Seconds by label and stage.
    """
    labels = list(seconds)
    with theme():
        size = (6.5, 0.4 * len(labels) + 1.1)
        figure = Figure(figsize=size, layout="constrained")
        axis = figure.subplots()
        left = np.zeros(len(labels))
        for stage, color in STAGES.items():
            width = np.array([seconds[label].get(stage, 0.0) for label in labels])
            axis.barh(labels, width, left=left, color=color, label=stage, height=0.6)
            left += width
        for row, total in enumerate(left):
            axis.text(total, row, f" {total:.3g} s", va="center", fontsize=8)
        axis.invert_yaxis()
        axis.margins(x=0.12)
        axis.set_xlabel("seconds")
        add_legend(figure, loc="outside upper center", ncols=len(STAGES))
    return figure
