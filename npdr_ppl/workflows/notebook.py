"""What posteriors and comparisons show of themselves in a notebook."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.displays.columns import scalar_columns
from npdr_ppl.displays.html import facts, table
from npdr_ppl.displays.marginal import draw_marginal
from npdr_ppl.displays.panels import panels
from npdr_ppl.displays.theme import COLORS, SERIES
from npdr_ppl.randomness import seeded
from npdr_ppl.workflows.units import parameter_units

if TYPE_CHECKING:
    from npdr_ppl.workflows.comparison import Comparison
    from npdr_ppl.workflows.posterior import PosteriorBase

__all__ = ["comparison_html", "plot_comparison", "plot_posterior", "posterior_html"]

NUM_DRAWS = 1_000
MAX_COLUMNS = 4


def posterior_html(posterior: "PosteriorBase") -> str:
    """Returns mean, spread and central interval of every parameter as HTML."""
    samples, prior = _samples(posterior, NUM_DRAWS, seed=0)
    units = parameter_units(posterior)
    rows = []
    for name, values in samples.items():
        low, high = np.quantile(values, [0.03, 0.97])
        spread = prior[name].std()
        learnt = f"{1 - values.std() / spread:.0%}" if spread > 0 else "–"
        rows.append(
            [
                name,
                units.get(name, "–"),
                f"{values.mean():.4g}",
                f"{values.std():.2g}",
                f"{low:.4g} … {high:.4g}",
                learnt,
            ]
        )
    head = facts(
        "Posterior",
        {
            "backend": posterior.backend_name,
            "parameters": str(len(samples)),
            "components": str(len(posterior.densities)),
        },
    )
    columns = ("parameter", "unit", "mean", "sd", "central 94 %", "contraction")
    return head + table(columns, rows)


def plot_posterior(
    posterior: "PosteriorBase", axes: Any = None, *, num_samples: int, seed: int
) -> NDArray[Any]:
    """Draws every marginal over its prior; see :meth:`PosteriorBase.plot`."""
    samples, prior = _samples(posterior, num_samples, seed=seed)
    units = parameter_units(posterior)
    drawn = panels(axes, len(samples), columns=MAX_COLUMNS, size=(2.6, 1.9))
    for axis, (name, values) in zip(drawn, samples.items(), strict=True):
        draw_marginal(axis, values, prior[name])
        unit = units.get(name, "")
        axis.set_xlabel(f"{name} [{unit}]" if unit and unit != "1" else name)
    drawn[0].legend()
    return drawn


def comparison_html(comparison: "Comparison") -> str:
    """Returns the ranking as HTML, failures with their reasons below."""
    rows = []
    for label in comparison.ranking:
        row = comparison.rows[label]
        figures, diagnosis = row.figures, row.diagnosis
        if figures is None or diagnosis is None:
            continue
        elpd = math.nan if figures.elpd is None else float(figures.elpd.sum())
        rows.append(
            [
                label,
                _number(elpd, ".1f"),
                _number(comparison.weights.get(label, math.nan), ".2f"),
                _number(float(np.mean(figures.rmse)) if figures.rmse else math.nan, ".3g"),
                _number(figures.crps, ".3g"),
                _number(diagnosis.r_hat, ".2f"),
                f"{sum(row.seconds.values()):.0f}",
                diagnosis.decision.value,
            ]
        )
    columns = ("backend", "elpd", "weight", "RMSE", "CRPS", "r̂", "seconds", "decision")
    failed = {label: row.error for label, row in comparison.rows.items() if row.error is not None}
    shown = table(columns, rows)
    return f"<div><strong>Comparison, the best first</strong>{shown}</div>" + (
        facts("Failed", failed) if failed else ""
    )


def plot_comparison(comparison: "Comparison", axes: Any = None) -> NDArray[Any]:
    """Draws scores and coverage; see :meth:`Comparison.plot`."""
    drawn = panels(axes, 2, columns=2, size=(4.2, 3.0))
    ranked = {label: comparison.rows[label].figures for label in comparison.ranking}
    scores, coverage = drawn
    for index, (label, figures) in enumerate(ranked.items()):
        if figures is None:
            continue
        color = SERIES[index % len(SERIES)]
        stacking = comparison.stacking
        if stacking is not None and label in stacking.difference:
            error = stacking.standard_error.get(label) or 0.0
            error = error if math.isfinite(error) else 0.0
            scores.errorbar(stacking.difference[label], index, xerr=error, fmt="o", color=color)
        levels = list(figures.coverage)
        coverage.plot(
            levels, [figures.coverage[v] for v in levels], "o-", color=color, label=label
        )
    scores.set_yticks(range(len(ranked)), list(ranked))
    scores.invert_yaxis()
    scores.set_xlabel("elpd behind the best ± standard error")
    coverage.plot([0, 1], [0, 1], ls=":", color=COLORS["prior"])
    coverage.set_xlabel("probability of the interval")
    coverage.set_ylabel("share of readings inside")
    if ranked:
        coverage.legend()
    return drawn


def _samples(
    posterior: "PosteriorBase", num_samples: int, *, seed: int
) -> tuple[dict[str, NDArray[np.float64]], dict[str, NDArray[np.float64]]]:
    """Returns draws of posterior and prior by scalar parameter."""
    prior = posterior.prior
    samples = {n: v.cpu() for n, v in posterior.sample(num_samples, seed=seed).items()}
    with seeded(seed, "figures"):
        before = {n: v.cpu() for n, v in prior.to_parameters(prior.sample(num_samples)).items()}
    return scalar_columns(samples), scalar_columns(before)


def _number(value: float, format_spec: str) -> str:
    return format(value, format_spec) if math.isfinite(value) else "–"
