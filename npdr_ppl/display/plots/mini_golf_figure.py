"""Figure 4 of Muratore et al. (2021): the posterior over golf ball and obstacle poses."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from npdr_ppl.display.plots.fit_figures import NUM_DRAWS, scalar_columns
from npdr_ppl.display.plots.pair import plot_pair
from npdr_ppl.drawing.theme import save_figure
from npdr_ppl.models.mini_golf.course import MEASURED_OBSTACLES, OBSTACLES
from npdr_ppl.posterior.posterior import Posterior
from npdr_ppl.randomness import seeded

__all__ = ["measured_shifts", "write_mini_golf_figures"]


def write_mini_golf_figures(
    posteriors: Mapping[str, Posterior], out: Path, *, seed: int = 0
) -> list[Path]:
    """Draws one posterior of each method, every two parameters against each other.

    Args:
        posteriors: A posterior by method.
        out: Folder for ``pairs_<method>.png``.
        seed: Seed of the draws.
    """
    paths = []
    for label, posterior in posteriors.items():
        draws = scalar_columns(posterior.sample(NUM_DRAWS, seed=seed))
        prior = posterior.prior
        with seeded(seed, "figures"):
            everywhere = scalar_columns(prior.to_parameters(prior.sample(NUM_DRAWS)))
        marks = {"motion capture": measured_shifts()}
        figure = plot_pair(draws, everywhere, marks=marks)
        paths.append(save_figure(figure, out / f"pairs_{label.replace(' ', '_')}.png"))
    return paths


def measured_shifts() -> dict[str, float]:
    """Returns the obstacle poses from motion capture relative to the plan, in m and rad."""
    shifts = {}
    for side, planned, seen in zip(("left", "right"), OBSTACLES, MEASURED_OBSTACLES, strict=True):
        x, y, degrees = seen
        shifts[f"{side}_shift_x"] = x - planned.centre[0]
        shifts[f"{side}_shift_y"] = y - planned.centre[1]
        turn = math.radians(degrees) - planned.angle
        shifts[f"{side}_turn"] = float(np.angle(np.exp(1j * turn)))
    return shifts
