"""Results of a discovery as bars and tables: ranking, held-out gap, separation."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from npdr_ppl.discovery.discovery_view import (
    MOST_BARS,
    draw_gap,
    draw_probabilities,
    probabilities,
    short_name,
)
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.screening.screening import DETECTABLE, Screened
from npdr_ppl.display.plots.marginals import add_legend
from npdr_ppl.drawing.theme import COLORS, theme

if TYPE_CHECKING:
    from npdr_ppl.discovery import Discovery

__all__ = ["plot_gap", "plot_ranking", "plot_separation"]

MOST_CANDIDATES = 12
"""Maximum number of candidates in the first panel."""

MOST_COLUMNS = 3


def plot_ranking(ranking: Sequence[Screened], discovery: "Discovery | None" = None) -> Figure:
    """Draws the candidates by separation, and the probabilities of the missing effects.

    Args:
        ranking: All candidates for the original model.
        discovery: The discovery; without it no probabilities are drawn.
    """
    panels = (
        []
        if discovery is None
        else probabilities(discovery.effects, discovery.search.rounds[-1].weights)
    )
    found = () if discovery is None else tuple(f.effect.name for f in discovery.effects)
    columns = min(MOST_COLUMNS, 1 + len(panels))
    rows = -(-(1 + len(panels)) // columns)
    with theme():
        most = max(
            len(ranking[:MOST_CANDIDATES]), *(min(len(b), MOST_BARS) for _, b, _ in panels), 2
        )
        size = (3.7 * columns, (0.27 * most + 0.9) * rows)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        _draw_candidates(axes[0], ranking[:MOST_CANDIDATES], found)
        for axis, (title, bars, chosen) in zip(axes[1:], panels, strict=False):
            draw_probabilities(axis, bars, chosen=chosen, title=title)
        for axis in axes[1 + len(panels) :]:
            axis.set_visible(False)
    return figure


def _draw_candidates(axis: Axes, ranking: Sequence[Screened], found: Sequence[str]) -> None:
    values = [max(candidate.separation, 0.1) for candidate in ranking]
    colors = [COLORS["posterior" if c.name in found else "prior"] for c in ranking]
    axis.barh(range(len(values)), values, color=colors, height=0.7)
    axis.axvline(DETECTABLE, color="k", ls="--", lw=0.8)
    axis.set_yticks(range(len(values)), [short_name(c.name) for c in ranking], fontsize=6)
    axis.set_ylim(max(len(values), 2) - 0.4, -0.6)
    axis.set_xscale("log")
    axis.set_xlim(1.0, 1.3 * max([*values, 10.0]))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel("separation from none [standard deviations]")
    axis.set_title("each alone, at the model as it was")


def plot_gap(gap: Mapping[str, Gap]) -> Figure:
    """Draws every metric on the held-out rollouts before and after.

    Args:
        gap: The metrics by name.
    """
    with theme():
        figure = Figure(figsize=(1.9 * len(gap) + 0.3, 2.9), layout="constrained")
        for axis, (metric, values) in zip(
            figure.subplots(1, len(gap), squeeze=False)[0], gap.items(), strict=True
        ):
            draw_gap(axis, metric, values)
        add_legend(figure, loc="outside upper center", ncols=2)
    return figure


def plot_separation(distance: NDArray[np.float64], names: Sequence[str]) -> Figure:
    """Draws the separation of the leading candidates after refitting the parameters.

    Args:
        distance: Standard deviations between the row's candidate at its best size and the
            column's at any size, ``(n, n)``; the diagonal is the distance from no effect.
        names: Names of the n candidates.
    """
    count = len(names)
    with theme():
        figure = Figure(figsize=(0.45 * count + 3.2, 0.42 * count + 1.2), layout="constrained")
        axis = figure.subplots()
        shown = np.clip(distance, 0.1, None)
        norm = LogNorm(1.0, max(100.0, float(shown.max())))
        image = axis.imshow(shown, norm=norm, cmap="cividis", aspect="auto")
        for i in range(count):
            for j in range(count):
                value = distance[i, j]
                axis.text(
                    j, i, f"{value:.1f}" if value < 9.95 else f"{value:.0f}",
                    ha="center", va="center", fontsize=6,
                    color="w" if norm(shown[i, j]) < 0.55 else "k",
                    weight="bold" if value < DETECTABLE else "normal",
                )  # fmt: skip
        labels = [f"{k}  {short_name(name)}" for k, name in enumerate(names, start=1)]
        axis.set_yticks(range(count), labels, fontsize=7)
        axis.set_xticks(range(count), [str(k) for k in range(1, count + 1)])
        axis.tick_params(length=0)
        axis.spines[:].set_visible(False)
        axis.set_xlabel("imitated by (diagonal: none)")
        figure.colorbar(image, ax=axis, label="separation [standard deviations]")
    return figure
