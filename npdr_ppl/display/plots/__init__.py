"""Figures: each function draws on matplotlib axes and returns the figure.

May import: everything but reports and the command line. Start reading at ``fit_figures.py``.
"""

from npdr_ppl.display.plots.bands import plot_bands
from npdr_ppl.display.plots.calibration import plot_coverage, plot_ranks
from npdr_ppl.display.plots.comparison_panels import (
    plot_bands_by_backend,
    plot_overlaid_marginals,
    plot_seconds,
)
from npdr_ppl.display.plots.heatmap import plot_heatmaps
from npdr_ppl.display.plots.marginals import plot_marginals
from npdr_ppl.display.plots.pair import plot_pair
from npdr_ppl.drawing.theme import save_figure

__all__ = [
    "plot_bands",
    "plot_bands_by_backend",
    "plot_coverage",
    "plot_heatmaps",
    "plot_marginals",
    "plot_overlaid_marginals",
    "plot_pair",
    "plot_ranks",
    "plot_seconds",
    "save_figure",
]
