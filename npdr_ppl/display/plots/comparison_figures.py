"""The figures of a comparison: posteriors, predictive bands and seconds side by side."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from npdr_ppl.display.plots.bands import nominal_line
from npdr_ppl.display.plots.comparison_panels import (
    plot_bands_by_backend,
    plot_overlaid_marginals,
    plot_seconds,
)
from npdr_ppl.display.plots.fit_figures import NUM_DRAWS, NUM_PREDICTIVE, scalar_columns
from npdr_ppl.display.plots.heatmap import plot_heatmaps
from npdr_ppl.display.plots.marginals import Samples
from npdr_ppl.drawing.theme import save_figure
from npdr_ppl.posterior.comparison.comparison_result import Comparison
from npdr_ppl.posterior.parameter_units import parameter_units
from npdr_ppl.preparation.draw_budget import affordable_draws
from npdr_ppl.preparation.evaluation import replay
from npdr_ppl.preparation.sampling_settings import DRAW_BUDGET
from npdr_ppl.progress import Step
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts

__all__ = ["write_comparison_figures"]

PANELS = 4
"""Maximum number of pair panels in a row."""

SMOOTHING = 1.0
"""Standard deviation of the smoothing of a pair panel, in bins; without it, a broad posterior
with two thousand draws looks speckled."""


def write_comparison_figures(
    comparison: Comparison,
    model: Any,
    rollouts: Rollouts,
    out: Path,
    *,
    seed: int = 0,
    progress: Step | None = None,
) -> list[Path]:
    """Draws all posteriors of a comparison, and their predictions for one rollout.

    Args:
        comparison: The comparison.
        model: The model without measurement noise, to draw only the simulator's spread.
        rollouts: The first of these is drawn.
        out: Folder for ``marginals.png``, ``pairs.png``, ``bands.png`` and ``seconds.png``.
        seed: Seed of the draws.
        progress: Called with the fraction done and a short status.
    """
    step = progress or (lambda fraction, status: None)
    step(None, "marginals")
    posteriors = {label: comparison.posteriors[label] for label in comparison.ranking}
    some = next(iter(posteriors.values()))
    draws = {label: q.sample(NUM_DRAWS, seed=seed) for label, q in posteriors.items()}
    samples = {label: scalar_columns(values) for label, values in draws.items()}
    with seeded(seed, "figures"):
        prior = scalar_columns(some.prior.to_parameters(some.prior.sample(NUM_DRAWS)))
    units = parameter_units(some.prior)
    figure = plot_overlaid_marginals(samples, prior, units=units)
    paths = [save_figure(figure, out / "marginals.png")]
    step(None, "pairs")
    if len(prior) > 1:
        x, y = most_informative(samples, prior)
        rows = _wrapped(samples)
        figure = plot_heatmaps(
            rows, x, y,
            ranges=(_range(x, samples, prior), _range(y, samples, prior)),
            units=(units.get(x, ""), units.get(y, "")),
            smoothing=SMOOTHING,
        )  # fmt: skip
        paths.append(save_figure(figure, out / "pairs.png"))
    step(None, "predictions")
    options = some.bound.options
    shown = rollouts[[0]]
    # The posteriors are simulated for one figure, so they share the memory budget.
    budget = DRAW_BUDGET.most_bytes // (4 * len(draws))
    num = affordable_draws(NUM_PREDICTIVE, shown.readings[0].size, budget=budget)
    replays = {
        label: replay(model, shown, {n: v[:num] for n, v in values.items()}, options)
        for label, values in draws.items()
    }
    replayed = next(iter(replays.values()))
    names = replayed.channel_names
    figure = plot_bands_by_backend(
        shown.times_of_series[0],
        shown.series(names)[0].numpy(),
        {label: found.series()[0].double().cpu().numpy() for label, found in replays.items()},
        channel_names=names,
        units=replayed.units,
        lines=nominal_line(model, shown, options),
        resets=replayed.inputs.start.double().numpy() * shown.time_step,
    )
    paths.append(save_figure(figure, out / "bands.png"))
    step(None, "seconds")
    seconds = {label: comparison.rows[label].seconds for label in comparison.ranking}
    paths.append(save_figure(plot_seconds(seconds), out / "seconds.png"))
    step(1.0, "")
    return paths


def most_informative(samples: Mapping[str, Samples], prior: Samples) -> tuple[str, str]:
    """Returns the two parameters that the posteriors contract most, on average."""
    contraction = {
        name: np.mean([1 - values[name].std() / prior[name].std() for values in samples.values()])
        for name in prior
    }
    first, second = sorted(contraction, key=lambda name: -contraction[name])[:2]
    # The model's order is kept, so that a repeated comparison has the same axes.
    return (first, second) if list(prior).index(first) < list(prior).index(second) else (
        second, first
    )  # fmt: skip


def _wrapped(panels: Mapping[str, Samples]) -> dict[str, dict[str, Samples]]:
    """Returns panels in rows of about equal length, with blank row titles."""
    count = -(-len(panels) // PANELS)
    length = -(-len(panels) // count)
    labels = list(panels)
    return {
        " " * row: {label: panels[label] for label in labels[row * length : (row + 1) * length]}
        for row in range(count)
    }


def _range(
    name: str,
    samples: Mapping[str, Samples],
    prior: Samples,
) -> tuple[float, float]:
    """Returns limits that show all posteriors, but not necessarily the whole prior.

    Posteriors often fill only a small part of the prior. The axes contain 99 % of every
    posterior and a margin of a quarter of that range, but end at the prior's ends.
    """
    ends = np.array([np.quantile(values[name], [0.005, 0.995]) for values in samples.values()])
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    margin = 0.25 * (high - low) or 0.05 * float(np.ptp(prior[name]))
    return max(low - margin, float(prior[name].min())), min(
        high + margin, float(prior[name].max())
    )
