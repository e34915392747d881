"""Predictive bands over the recording, as in Figure 5 of Muratore et al. (2021)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from npdr_ppl.display.plots.marginals import add_legend
from npdr_ppl.drawing.theme import COLORS, theme
from npdr_ppl.errors import DataError
from npdr_ppl.language.model import Model
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.evaluation import nominal_parameters, replay
from npdr_ppl.rollouts import Rollouts

__all__ = ["nominal_line", "plot_bands", "with_breaks"]

GAP = 1.5
"""Time between two rows, in usual ones, from which nothing is drawn between them."""


def plot_bands(
    time: NDArray[np.float64],
    measured: NDArray[np.float64],
    predictive: NDArray[np.float64],
    *,
    channel_names: Sequence[str],
    units: Sequence[str] = (),
    lines: Mapping[str, NDArray[np.float64]] | None = None,
    resets: NDArray[np.float64] | None = None,
) -> Figure:
    """Draws the recording, the posterior predictive's bands and single simulations.

    Args:
        time: Seconds, ``(T,)``. Nothing is drawn across gaps.
        measured: The recording, ``(T, C)``.
        predictive: Posterior predictive draws, ``(n, T, C)``.
        channel_names: Names of the C channels.
        units: Units of the C channels.
        lines: Simulations ``(T, C)`` by legend entry, e.g. nominal and most likely.
        resets: Times at which the simulation was re-synchronised.
    """
    count = measured.shape[-1]
    with theme():
        figure = Figure(figsize=(7.5, 1.7 * count + 0.4), layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, squeeze=False).ravel()
        for c, axis in enumerate(axes):
            ends = [measured[:, c].min(), measured[:, c].max()]
            for low, high, alpha in ((0.05, 0.95, 0.2), (0.25, 0.75, 0.35)):
                band = np.quantile(predictive[..., c], [low, high], axis=0)
                ends += [band.min(), band.max()]
                axis.fill_between(
                    *with_breaks(time, *band), color=COLORS["posterior"], alpha=alpha, lw=0,
                    label=f"posterior {high - low:.0%}",
                )  # fmt: skip
            for label, line in (lines or {}).items():
                axis.plot(
                    *with_breaks(time, line[:, c]),
                    color=COLORS.get(label, "C1"),
                    lw=0.9,
                    label=label,
                )
            shown = with_breaks(time, measured[:, c])
            axis.plot(*shown, color=COLORS["measured"], lw=1.1, label="measured")
            if np.isfinite(ends).all():
                # Recording and bands set the axis limits; lines outside them are cut.
                margin = 0.05 * (max(ends) - min(ends)) + np.finfo(float).tiny
                axis.set_ylim(min(ends) - margin, max(ends) + margin)
            for reset in [] if resets is None else resets:
                axis.axvline(reset, color="0.85", lw=0.6, zorder=0)
            unit = units[c] if c < len(units) else ""
            axis.set_ylabel(f"{channel_names[c]}\n[{unit}]" if unit else channel_names[c])
        axes[-1].set_xlabel("time [s]")
        axes[0].set_xlim(time[0], time[-1])
        add_legend(figure, loc="outside upper center", ncols=5)
    return figure


def with_breaks(
    time: NDArray[np.float64], *columns: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Returns times and columns with NaN in each gap of the time, so that no line crosses it.

    Args:
        time: Seconds, ``(T,)``.
        columns: Values at these times, ``(T,)`` each.
    """
    if len(time) < 2:
        return time, *columns
    steps = np.diff(time)
    breaks = 1 + np.flatnonzero(steps > GAP * np.median(steps))
    return tuple(np.insert(each, breaks, np.nan) for each in (time, *columns))


def nominal_line(
    model: Model, rollouts: Rollouts, options: DataOptions
) -> dict[str, NDArray[np.float64]]:
    """Returns the nominal simulation of the first rollout, for :func:`plot_bands`.

    Args:
        model: The model without measurement noise.
        rollouts: The recording.
        options: Segments, initial states and precision.

    Returns:
        The simulation ``(T, C)`` by its legend entry; empty if a parameter has no nominal
        value or nominal parameters cannot be simulated.
    """
    shown = rollouts[[0]]
    try:
        nominal = nominal_parameters(model, options.with_certain_start().inputs(shown))
    except DataError:
        return {}
    batched = {name: value[None] for name, value in nominal.items()}
    line = replay(model, shown, batched, options).series()[0][0].double().cpu().numpy()
    return {"nominal": line} if np.isfinite(line).all() else {}
