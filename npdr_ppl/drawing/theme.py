"""Common style of all figures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COLORS", "SERIES", "save_figure", "theme"]

# Okabe and Ito's palette, which colour-blind readers can distinguish.
COLORS = {
    "posterior": "#0072B2",
    "prior": "#999999",
    "measured": "#000000",
    "nominal": "#D55E00",
    "most likely": "#009E73",
    "truth": "#CC79A7",
}

SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
"""The same palette for several posteriors in one panel, used in this order and repeated."""

_STYLE: Any = {
    "figure.dpi": 120,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.frameon": False,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}


@contextmanager
def theme() -> Iterator[None]:
    """Applies the style inside the block."""
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        yield


def save_figure(figure: "Figure", path: Path) -> Path:
    """Writes a figure and returns its path; no display is needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, bbox_inches="tight", dpi=150)
    return path
