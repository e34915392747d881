"""Map of a model's residuals: standardised residuals over time and channel."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.residual_map import (
    Spot,
    noise_of,
    residuals_by_rollout,
    thinned,
)
from npdr_ppl.drawing.theme import COLORS, theme

__all__ = ["plot_residual_map"]

MOST_ROLLOUTS = 5
"""Maximum number of rollouts; those with the worst windows are preferred."""

MOST_COLUMNS = 500
"""Maximum number of cells along the time axis; a cell shows the root mean square of its values."""

QUIETEST = 1.0
"""Residuals below one standard deviation of the measurement noise have the same colour."""


def plot_residual_map(
    before: Hypothesis, after: Hypothesis | None = None, where: Sequence[Spot] = ()
) -> Figure:
    """Draws |residual| in standard deviations of the measurement noise, one panel per rollout.

    Args:
        before: The original model, fitted.
        after: The revised model, drawn in a second column.
        where: The worst windows of the original model, marked and numbered.
    """
    names = before.segments.channel_names
    columns = {"the model as it was": before}
    if after is not None and after is not before:
        columns["the revised model"] = after
    shown = _shown(before, where)
    noise = noise_of(before)
    maps = [residuals_by_rollout(hypothesis, noise) for hypothesis in columns.values()]
    loudest = max(float(np.nanquantile(found[row], 0.995)) for found in maps for row in shown)
    norm = LogNorm(QUIETEST, max(10.0 * QUIETEST, loudest))
    step = before.segments.inputs.time_step
    with theme():
        size = (4.0 * len(columns) + 1.2, (0.22 * len(names) + 0.5) * len(shown) + 0.8)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(shown), len(columns), sharey=True, squeeze=False)
        image = None
        for column, (title, found) in enumerate(zip(columns, maps, strict=True)):
            axes[0, column].set_title(title)
            for axis, rollout in zip(axes[:, column], shown, strict=True):
                z = thinned(found[rollout], MOST_COLUMNS)
                edges = np.linspace(0.0, len(found[rollout]) * step, len(z) + 1)
                image = axis.pcolormesh(
                    edges, np.arange(len(names) + 1), z.T, norm=norm, cmap="magma_r",
                    rasterized=True,
                )  # fmt: skip
                axis.spines[:].set_visible(False)
                axis.set_yticks(np.arange(len(names)) + 0.5, names)
                axis.tick_params(axis="y", length=0)
                axis.set_ylim(len(names), 0)
                if column == 0:
                    axis.set_ylabel(f"rollout {rollout}")
                    _mark(axis, rollout, where, names)
            axes[-1, column].set_xlabel("time [s]")
        if image is not None:
            figure.colorbar(image, ax=axes, extend="both", label="|residual| / measurement noise")
    return figure


def _mark(axis: Axes, rollout: int, where: Sequence[Spot], names: Sequence[str]) -> None:
    """Frames a rollout's worst windows and writes their ranks inside."""
    for rank, spot in enumerate(where, start=1):
        if spot.rollout != rollout:
            continue
        begin, end = spot.time_span
        frame = Rectangle(
            (begin, names.index(spot.channel)), end - begin, 1.0,
            fill=False, ec=COLORS["posterior"], lw=1.2, clip_on=False,
        )  # fmt: skip
        axis.add_patch(frame)
        axis.text(
            0.5 * (begin + end), names.index(spot.channel) + 0.5, str(rank), ha="center",
            va="center", fontsize=7, color="w", clip_on=True,
            path_effects=[withStroke(linewidth=1.5, foreground=COLORS["posterior"])],
        )  # fmt: skip


def _shown(hypothesis: Hypothesis, where: Sequence[Spot]) -> list[int]:
    """Returns the rollouts to draw, in the order of the recording."""
    every = hypothesis.segments.inputs.rollout.unique().tolist()
    loud = list(dict.fromkeys(spot.rollout for spot in where))
    return sorted([*loud, *(r for r in every if r not in loud)][:MOST_ROLLOUTS])
