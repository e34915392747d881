"""Figures of a calibration: rank distributions and coverage, each with its confidence band."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from npdr_ppl.display.plots.marginals import add_legend
from npdr_ppl.drawing.theme import COLORS, theme
from npdr_ppl.posterior.calibration.calibration_result import HIGHEST_DENSITY, TARP, Calibration
from npdr_ppl.posterior.calibration.uniformity import Band, simultaneous_band

__all__ = ["plot_coverage", "plot_ranks"]

MAX_COLUMNS = 4
BAND = 0.95
"""Probability that all of a calibrated posterior's curve lies in its band."""


def plot_ranks(calibration: Calibration) -> Figure:
    """Draws how every parameter's rank distribution differs from the uniform one.

    The curves follow Säilynoja et al. (2022): the empirical distribution function minus the
    uniform one, with its 95 % simultaneous band. A curve above zero on the left and below zero on
    the right (the truth is too often in the tails) means over-confidence, the reverse
    under-confidence. A curve on one side of zero means bias.

    Args:
        calibration: The ranks.
    """
    names = calibration.parameters
    band = simultaneous_band(calibration.num_datasets, calibration.num_draws, BAND)
    columns = min(MAX_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    with theme():
        figure = Figure(figsize=(2.6 * columns, 1.9 * rows + 0.3), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axis, name in zip(axes.ravel(), names, strict=False):
            _draw_difference(axis, calibration, name, band)
            axis.set_title(name)
        for axis in axes.ravel()[len(names) :]:
            axis.set_visible(False)
        for axis in axes.ravel()[: len(names)][-columns:]:
            axis.tick_params(labelbottom=True)
        for axis in axes[:, 0]:
            axis.set_ylabel("ECDF difference")
        figure.supxlabel("rank of the truth / draws", fontsize=9)
        add_legend(figure, loc="outside upper center", ncols=2)
    return figure


def plot_coverage(
    calibration: Calibration, quantities: Sequence[str] = (HIGHEST_DENSITY, TARP)
) -> Figure:
    """Draws expected against nominal coverage, with the band of a calibrated posterior.

    Below the diagonal, regions contain the truth less often than their nominal probability: the
    posterior is over-confident (or biased).

    Args:
        calibration: The ranks.
        quantities: ``"highest_density"``, ``"tarp"``: one panel each.
    """
    band = simultaneous_band(calibration.num_datasets, calibration.num_draws, BAND)
    titles = {HIGHEST_DENSITY: "highest-density regions", TARP: "random balls (TARP)"}
    with theme():
        figure = Figure(figsize=(3.0 * len(quantities), 3.2), layout="constrained")
        axes = figure.subplots(1, len(quantities), squeeze=False, sharey=True).ravel()
        for axis, quantity in zip(axes, quantities, strict=True):
            _draw_coverage(axis, calibration, quantity, band)
            axis.set_title(f"{titles.get(quantity, quantity)}, {_p_value(calibration, quantity)}")
            axis.set_xlabel("nominal coverage")
        axes[0].set_ylabel("expected coverage")
        add_legend(figure, loc="outside upper center", ncols=3)
    return figure


def _draw_difference(axis: Axes, calibration: Calibration, name: str, band: Band) -> None:
    t = band.positions
    axis.fill_between(
        t, band.low - t, band.high - t, color=COLORS["prior"], alpha=0.3, lw=0,
        label=f"{BAND:.0%} band",
    )  # fmt: skip
    share = _share_below(calibration, name, t)
    axis.plot(t, share - t, color=COLORS["posterior"], lw=1.2, label="ranks")
    axis.axhline(0.0, color=COLORS["prior"], lw=0.6)
    axis.text(
        0.97, 0.95, _p_value(calibration, name), transform=axis.transAxes, ha="right", va="top",
        fontsize=7,
    )  # fmt: skip


def _draw_coverage(axis: Axes, calibration: Calibration, quantity: str, band: Band) -> None:
    t = band.positions
    axis.fill_between(
        t, band.low, band.high, color=COLORS["prior"], alpha=0.3, lw=0, label=f"{BAND:.0%} band"
    )
    axis.plot([0, 1], [0, 1], color=COLORS["prior"], lw=0.8, ls="--", label="calibrated")
    axis.plot(
        t, _share_below(calibration, quantity, t), color=COLORS["posterior"], lw=1.2,
        label="posterior",
    )  # fmt: skip
    axis.set_xlim(0, 1)
    axis.set_ylim(0, 1)
    axis.set_aspect("equal")


def _share_below(calibration: Calibration, quantity: str, t: np.ndarray) -> np.ndarray:
    """Returns the share of ranks below the fractions t of their range."""
    ranks = np.sort(calibration.ranks_of(quantity))
    thresholds = np.round(t * (calibration.num_draws + 1))
    return np.searchsorted(ranks, thresholds) / len(ranks)


def _p_value(calibration: Calibration, quantity: str) -> str:
    p = calibration.p_values[quantity]
    return f"p = {p:.2g}" if p >= 1e-4 else "p < 0.0001"
