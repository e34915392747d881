"""Figure 2 of Muratore et al. (2021): the pendulum's posterior over rounds, and NUTS."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.display.plots.heatmap import plot_heatmaps
from npdr_ppl.drawing.theme import save_figure
from npdr_ppl.reproduction.pendulum_ridge import RANGE, ROUNDS, Ridge

__all__ = ["write_pendulum_figures"]

SHOWN_ROUNDS = (0, 2, ROUNDS - 1)


def write_pendulum_figures(ridges: Mapping[str, Ridge], out: Path) -> list[Path]:
    """Draws every method's posterior after rounds 1, 3 and 8 and NUTS, one file per duration.

    Args:
        ridges: The posteriors by duration, e.g. ``"8 s"``.
        out: Folder for ``pendulum_8_s.png`` and so on.
    """
    paths = []
    for duration, ridge in ridges.items():
        rows = {}
        for label, posterior in ridge.posteriors.items():
            last = len(posterior.states) - 1
            shown = [index for index in SHOWN_ROUNDS if index < last] + [last]
            panels = {f"round {i + 1}": _columns(ridge.samples(label, i)) for i in shown}
            rows[label] = panels | {"NUTS": _columns(ridge.reference)}
        figure = plot_heatmaps(
            rows,
            "mass",
            "length",
            ranges=(RANGE, RANGE),
            truth={"mass": 1.0, "length": 1.0},
            curve=ridge.valley,
            units=("kg", "m"),
        )
        name = f"pendulum_{duration.replace(' ', '_')}.png"
        paths.append(save_figure(figure, out / name))
    return paths


def _columns(samples: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {"mass": samples[:, 0], "length": samples[:, 1]}
