"""Map of a model's residuals: standardised residuals over time and channel."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.residual_map import Spot
from npdr_ppl.drawing.theme import COLORS, theme
from npdr_ppl.rollouts.states import measurement_noise

__all__ = ["plot_residual_map"]

MOST_ROLLOUTS = 5
"""Maximum number of rollouts; those with the worst windows are preferred."""

MOST_COLUMNS = 500
"""Maximum number of cells along the time axis; a cell shows the root mean square of its values."""

QUIETEST = 1.0
"""Residuals below one standard deviation of the measurement noise have the same colour."""

Array = NDArray[np.float64]


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
    noise = _noise(before)
    maps = [_by_rollout(hypothesis, noise) for hypothesis in columns.values()]
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
                z = _thinned(found[rollout])
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


def _noise(hypothesis: Hypothesis) -> torch.Tensor:
    """Returns the standard deviation of the measurement noise, ``(C,)``."""
    segments = hypothesis.segments
    series = [o[m] for o, m in zip(segments.observed, segments.inputs.mask, strict=True)]
    return measurement_noise(series).clamp_min(1e-9)


def _by_rollout(hypothesis: Hypothesis, noise: torch.Tensor) -> dict[int, Array]:
    """Returns |residual| in units of noise, ``(T, C)`` by rollout; NaN outside the segments."""
    segments, fit = hypothesis.segments, hypothesis.fit
    residual = segments.residuals(fit.z[None], fit.offsets[None], noise)[0]
    z = residual.unflatten(-1, (-1, len(noise))).abs()
    inputs = segments.inputs
    found = {}
    for rollout in inputs.rollout.unique().tolist():
        rows = torch.nonzero(inputs.rollout == rollout)[:, 0].tolist()
        starts = inputs.start.tolist()
        counts = inputs.mask.sum(-1).tolist()
        length = max(starts[row] + counts[row] for row in rows)
        values = np.full((length, len(noise)), np.nan)
        for row in rows:
            values[starts[row] : starts[row] + counts[row]] = z[row, : counts[row]].numpy()
        found[rollout] = values
    return found


def _thinned(values: Array) -> Array:
    """Returns the root mean square over the steps of each cell, ``(cells, C)``."""
    width = -(-len(values) // MOST_COLUMNS)
    padding = -len(values) % width
    padded = np.concatenate((values, np.full((padding, values.shape[1]), np.nan)))
    cells = padded.reshape(-1, width, values.shape[1])
    count = np.isfinite(cells).sum(1)
    total = np.nansum(cells**2, axis=1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))
