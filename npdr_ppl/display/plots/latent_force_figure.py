"""The force that a model lacks, plotted against channels, commands and time."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.discovery.screening.latent_force import (
    LatentForce,
    Responses,
    latent_force,
    responses,
)
from npdr_ppl.discovery.screening.projection import Projection
from npdr_ppl.discovery.search.rounds import Round
from npdr_ppl.display.plots.marginals import add_legend
from npdr_ppl.drawing.theme import COLORS, theme

__all__ = ["plot_latent_force"]

BINS = 15
"""Number of bins along a channel, of equal width between its 1 % and 99 % quantiles."""

FEWEST = 8
"""Minimum number of estimates in a bin; bins with fewer are not drawn."""

MOST_DOTS = 250
"""Maximum number of estimates drawn as dots, chosen at random; the line uses all estimates."""

WIDTH = 2.0
"""Half the band's width, in standard errors of a bin's mean."""

BEFORE, AFTER = "the model as it was", "the revised model"

LOOKS = {BEFORE: COLORS["nominal"], AFTER: COLORS["posterior"]}

Array = NDArray[np.float64]


def plot_latent_force(
    first: Round, last: Round | None = None, units: Mapping[str, str] | None = None
) -> Figure | None:
    """Draws the missing force at every joint against every channel, command and time.

    Each dot is the mean force over a pulse. The line is the mean of the dots in bins, weighted by
    the estimates' precision, and the band is two standard errors of it. The lines and bands set
    the axis limits, so some dots lie outside.

    Args:
        first: Round of the search with the original model.
        last: Round of the search with the revised model.
        units: Units of channels and commands by name.

    Returns:
        The figure, or ``None`` if the model has no joint on which a force can act.
    """
    rounds = {BEFORE: first}
    if last is not None and last.hypothesis is not first.hypothesis:
        rounds[AFTER] = last
    pushed = {title: responses(now.averaged) for title, now in rounds.items()}
    forces = {title: _forces(now, pushed[title]) for title, now in rounds.items()}
    ports = list(forces[BEFORE])
    if not ports:
        return None
    against = {title: _axes_of(found) for title, found in pushed.items()}
    names = list(against[BEFORE])
    with theme():
        size = (1.75 * len(names) + 0.6, 1.7 * len(ports) + 0.5)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(ports), len(names), sharex="col", sharey="row", squeeze=False)
        for row, port in zip(axes, ports, strict=True):
            reach = [
                _draw(axis, against[title][name], found[port], title, pushed[title].is_recorded)
                for title, found in forces.items()
                for axis, name in zip(row, names, strict=True)
                if port in found
            ]
            for axis in row:
                axis.axhline(0.0, color="0.8", lw=0.6, zorder=0)
                axis.ticklabel_format(axis="y", scilimits=(-2, 3))
            limit = 1.5 * max(reach) + np.finfo(float).tiny
            row[0].set_ylim(-limit, limit)
            unit = forces[BEFORE][port].unit
            row[0].set_ylabel(f"missing at\n{port}\n[{unit}]", fontsize="small")
        for axis, name in zip(axes[-1], names, strict=True):
            unit = "s" if name == "time" else (units or {}).get(name, "")
            axis.set_xlabel(f"{name} [{unit}]" if unit else name)
        add_legend(figure, loc="outside upper center", ncols=len(rounds))
    return figure


def _draw(axis: Axes, x: Array, found: LatentForce, title: str, is_recorded: Tensor) -> float:
    """Draws one joint's force against one channel; returns the band's largest magnitude."""
    inside = is_recorded.numpy().ravel()
    x, force = x[inside], found.force.numpy().ravel()[inside]
    precision = found.error.numpy().ravel()[inside].clip(1e-12) ** -2.0
    few = np.random.default_rng(0).permutation(len(x))[:MOST_DOTS]
    axis.plot(
        x[few], force[few], ".", ms=1.5, alpha=0.4, color=LOOKS[title], rasterized=True, zorder=1
    )
    centre, mean, error = _binned(x, force, precision)
    axis.fill_between(
        centre, mean - WIDTH * error, mean + WIDTH * error,
        color=LOOKS[title], alpha=0.3, lw=0, zorder=2,
    )  # fmt: skip
    axis.plot(centre, mean, color=LOOKS[title], lw=1.2, label=title, zorder=3)
    return float((np.abs(mean) + WIDTH * error).max(initial=0.0))


def _binned(x: Array, y: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Returns centres, weighted means and their standard errors."""
    low, high = np.quantile(x, 0.01), np.quantile(x, 0.99)
    edges = np.linspace(low, high, BINS + 1)
    place = np.digitize(x, edges[1:-1])
    rows = []
    for bin_index in range(BINS):
        part = place == bin_index
        if part.sum() < FEWEST:
            continue
        share = weight[part] / weight[part].sum()
        mean = float(share @ y[part])
        error = float(np.sqrt((share**2) @ (y[part] - mean) ** 2))
        rows.append((float(share @ x[part]), mean, error))
    centre, mean, error = np.array(rows).reshape(-1, 3).T
    return centre, mean, error


def _forces(now: Round, pushed: Responses) -> dict[str, LatentForce]:
    found = latent_force(Projection(now.averaged), pushed)
    return {force.port: force for force in found}


def _axes_of(pushed: Responses) -> dict[str, Array]:
    """Returns channels, commands and time in the order of the flattened forces."""
    values = {name: v.numpy().ravel() for name, v in pushed.channels.items()}
    return values | {"time": pushed.time.numpy().ravel()}
