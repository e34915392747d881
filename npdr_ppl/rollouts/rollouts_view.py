"""Tables and plots of rollouts in a notebook."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.drawing.html import facts, table
from npdr_ppl.drawing.page_style import styled
from npdr_ppl.drawing.panels import panels
from npdr_ppl.drawing.theme import SERIES
from npdr_ppl.rollouts.recording import Recording

__all__ = ["plot_rollouts", "rollouts_html"]

MAX_DRAWN = 50
"""Greatest number of rollouts in one plot; the others are left out."""


def rollouts_html(rollouts: Recording) -> str:
    """Returns length, time step and the range of every channel as HTML."""
    low, high = min(rollouts.lengths), max(rollouts.lengths)
    steps = f"{low}" if low == high else f"{low} to {high}"
    head = facts(
        "Rollouts",
        {
            "rollouts": str(len(rollouts)),
            "steps": steps,
            "time step": f"{rollouts.time_step:.6g} s",
            "rewards": "no" if rollouts.rewards is None else "yes",
        },
    )
    rows = []
    for kind, names, units, series in _channels(rollouts):
        for column, (name, unit) in enumerate(zip(names, units, strict=True)):
            values = np.concatenate([one[:, column] for one in series])
            values = values[np.isfinite(values)]
            span = [f"{v:.4g}" for v in (values.min(), values.max())] if len(values) else ["–"] * 2
            rows.append([name, kind, unit or "–", *span])
    return styled(head + table(("channel", "kind", "unit", "least", "greatest"), rows))


def plot_rollouts(rollouts: Recording, axes: Any = None) -> NDArray[Any]:
    """Plots every channel over time and returns the axes; see :meth:`Rollouts.plot`."""
    count = len(rollouts.channel_names) + len(rollouts.action_names)
    drawn = panels(axes, count, columns=1, size=(7.5, 1.4))
    row = 0
    for kind, names, units, series in _channels(rollouts):
        for column, (name, unit) in enumerate(zip(names, units, strict=True)):
            axis = drawn[row]
            row += 1
            for index, values in enumerate(series[:MAX_DRAWN]):
                time = rollouts.time[index][: len(values)]
                style = "steps-post" if kind == "action" else "default"
                color = SERIES[index % len(SERIES)]
                axis.plot(time, values[:, column], drawstyle=style, color=color, lw=1.0)
            axis.set_ylabel(f"{name}\n[{unit}]" if unit else name)
    drawn[-1].set_xlabel("time [s]")
    return drawn


def _channels(rollouts: Recording) -> list[tuple[str, Any, Any, Any]]:
    """Returns kind, names, units and values, for sensors and for actions; values per rollout."""
    return [
        ("sensor", rollouts.channel_names, rollouts.channel_units, rollouts.readings),
        ("action", rollouts.action_names, rollouts.action_units, rollouts.actions),
    ]
