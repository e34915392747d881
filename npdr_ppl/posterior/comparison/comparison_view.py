"""What a comparison shows of itself in a notebook."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.drawing.html import facts, table
from npdr_ppl.drawing.numbers import number
from npdr_ppl.drawing.page_style import styled
from npdr_ppl.drawing.panels import panels
from npdr_ppl.drawing.theme import COLORS, SERIES
from npdr_ppl.posterior.comparison.comparison_rows import Row
from npdr_ppl.posterior.comparison.stacking import Stacking

__all__ = ["comparison_html", "plot_comparison"]


def comparison_html(
    rows: Mapping[str, Row], ranking: Sequence[str], weights: Mapping[str, float]
) -> str:
    """Returns the ranking as HTML, failures with their reasons below.

    Args:
        rows: What became of every backend, by label.
        ranking: Labels from the best to the worst.
        weights: Stacking weights by label.
    """
    shown_rows = []
    for label in ranking:
        row = rows[label]
        figures, diagnosis = row.figures, row.diagnosis
        if figures is None or diagnosis is None:
            continue
        elpd = math.nan if figures.elpd is None else float(figures.elpd.sum())
        shown_rows.append(
            [
                label,
                number(elpd, ".1f"),
                number(weights.get(label, math.nan), ".2f"),
                number(float(np.mean(figures.rmse)) if figures.rmse else math.nan, ".3g"),
                number(figures.crps, ".3g"),
                number(diagnosis.r_hat, ".2f"),
                f"{sum(row.seconds.values()):.0f}",
                diagnosis.decision.value,
            ]
        )
    columns = ("backend", "elpd", "weight", "RMSE", "CRPS", "r̂", "seconds", "decision")
    failed = {label: row.error for label, row in rows.items() if row.error is not None}
    shown = table(columns, shown_rows)
    return styled(
        f"<div><strong>Comparison, the best first</strong>{shown}</div>"
        + (facts("Failed", failed) if failed else "")
    )


def plot_comparison(
    rows: Mapping[str, Row],
    ranking: Sequence[str],
    stacking: Stacking | None,
    axes: Any = None,
) -> NDArray[Any]:
    """Draws how far each backend is behind the best, and the coverage of its predictions.

    Args:
        rows: What became of every backend, by label.
        ranking: Labels from the best to the worst.
        stacking: Differences to the best; ``None`` where no backend has a finite elpd.
        axes: Two axes to draw on; ``None`` makes a figure.
    """
    drawn = panels(axes, 2, columns=2, size=(4.2, 3.0))
    ranked = {label: rows[label].figures for label in ranking}
    scores, coverage = drawn
    for index, (label, figures) in enumerate(ranked.items()):
        if figures is None:
            continue
        color = SERIES[index % len(SERIES)]
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
