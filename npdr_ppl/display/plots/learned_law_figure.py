"""A learned law over each of its variables, and what a missing force would be without a law."""

from matplotlib.figure import Figure

from npdr_ppl.discovery.learning.curves import Curve
from npdr_ppl.discovery.learning.result import Learned
from npdr_ppl.discovery.learning.term import symbol_of
from npdr_ppl.display.plots.marginals import add_legend
from npdr_ppl.drawing.theme import COLORS, theme

__all__ = ["plot_learned_law"]

WIDTH = 2.0
"""Half the length of an error bar, in standard errors."""


def plot_learned_law(learned: Learned) -> Figure:
    """Draws a row for each law, and a panel for each variable that it depends on.

    Every point is a mean over the parts of the recording with similar values of the variable. The
    band is that of the law, and a bar is two standard errors of the estimate without a law.

    Args:
        learned: The learned laws.
    """
    rows: dict[str, list[Curve]] = {}
    for curve in learned.curves:
        rows.setdefault(curve.port, []).append(curve)
    width = max(len(row) for row in rows.values())
    with theme():
        size = (2.3 * width + 0.8, 2.0 * len(rows) + 0.5)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(rows), width, squeeze=False)
        for row, found in zip(axes, rows.values(), strict=True):
            for axis, curve in zip(row, found, strict=False):
                low, high = zip(*curve.band, strict=True)
                color = COLORS["posterior"]
                axis.fill_between(curve.at, low, high, color=color, alpha=0.3, lw=0)
                axis.plot(curve.at, curve.law, color=color, lw=1.4, label="learned law")
                if curve.estimate:
                    bars = [WIDTH * error for error in curve.error]
                    axis.errorbar(
                        curve.at,
                        curve.estimate,
                        bars,
                        fmt=".",
                        ms=4,
                        lw=0.8,
                        color=COLORS["nominal"],
                        label="estimated without a law",
                    )
                axis.axhline(0.0, color="0.8", lw=0.6, zorder=0)
                axis.set_xlabel(f"{symbol_of(curve.variable)} [{curve.variable_unit}]")
            row[0].set_ylabel(f"{found[0].port} [{found[0].unit}]")
            for axis in row[len(found) :]:
                axis.set_visible(False)
        add_legend(figure, loc="outside upper center", ncols=2)
    return figure
