"""Figure 2 of Muratore et al. (2021): the pendulum's posterior over rounds, and NUTS."""

from collections.abc import Mapping
from pathlib import Path

from npdr_ppl.plots.heatmap import plot_rounds
from npdr_ppl.plots.theme import save_figure
from npdr_ppl.workflows.pendulum_ridge import RANGE, ROUNDS, Ridge

__all__ = ["write_pendulum_figures"]

SHOWN_ROUNDS = (0, 2, ROUNDS - 1)


def write_pendulum_figures(ridges: Mapping[str, Ridge], out: Path) -> list[Path]:
    """Draws the posterior after rounds 1, 3 and 8 beside NUTS, one figure per duration.

    Args:
        ridges: The posteriors by duration, e.g. ``"8 s"``.
        out: Folder for ``pendulum_8_s.png`` and so on.
    """
    paths = []
    for duration, ridge in ridges.items():
        panels = {f"round {i + 1}": ridge.samples(i) for i in SHOWN_ROUNDS}
        panels["NUTS"] = ridge.reference
        figure = plot_rounds(
            {
                title: {"mass": samples[:, 0], "length": samples[:, 1]}
                for title, samples in panels.items()
            },
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
