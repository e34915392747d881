"""Confusion and reliability of the blind benchmark, as numbers and as figures."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from discovery_rows import (
    REMOVED,
    SEVERAL,
    Row,
    effect_id,
    first_probability,
    found_names,
    is_first_right,
)
from discovery_table import Rate
from matplotlib.figure import Figure

from npdr_ppl.drawing.theme import COLORS, save_figure, theme

__all__ = [
    "Bin",
    "calibration_error",
    "calibration_error_by_chance",
    "confusion",
    "reliability",
    "write_figures",
]

EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0)
"""Bins of the reported probabilities."""


@dataclass(frozen=True)
class Bin:
    """Cases whose reported probability lies in one range: how many, its mean, and how many right.

    Attributes:
        low: Lower end of the range.
        high: Upper end.
        mean: Mean of the reported probabilities.
        right: How many of the cases were right.
    """

    low: float
    high: float
    mean: float
    right: Rate


def reliability(rows: Iterable[Row]) -> list[Bin]:
    """Returns how often first effects are right, by their reported probability."""
    pairs = [
        (first_probability(row), is_first_right(row))
        for row in rows
        if row["condition"] in ("one", "inseparable", *SEVERAL) and found_names(row)
    ]
    bins = []
    for low, high in zip(EDGES[:-1], EDGES[1:], strict=True):
        own = [(p, r) for p, r in pairs if low <= p < high or (p >= high == EDGES[-1])]
        if own:
            mean = float(np.mean([p for p, _ in own]))
            bins.append(Bin(low, high, mean, Rate(sum(r for _, r in own), len(own))))
    return bins


def calibration_error(bins: Sequence[Bin]) -> float:
    """Returns the expected calibration error: the bins' mean distance, weighted by cases."""
    total = sum(part.right.total for part in bins)
    return sum(part.right.total * abs(part.mean - part.right.value) for part in bins) / total


def calibration_error_by_chance(bins: Sequence[Bin], *, num_draws: int = 10_000) -> float:
    """Returns what the error of perfect probabilities stays below in 95 of 100 such samples.

    Args:
        bins: The bins, whose means are taken for true and whose numbers of cases are kept.
        num_draws: Samples that are drawn.
    """
    totals = np.array([part.right.total for part in bins])
    means = np.array([part.mean for part in bins])
    right = np.random.default_rng(0).binomial(totals, means, (num_draws, len(bins)))
    errors = np.abs(right - totals * means).sum(-1) / totals.sum()
    return float(np.quantile(errors, 0.95))


def confusion(rows: Iterable[Row]) -> dict[str, Counter[str]]:
    """Returns how often what was hidden got which name.

    An effect counts under its own name if it, or what stands for it, was found first; the same
    effect at another port is a class of its own, and what was not named has the verdict's name.
    """
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        if row["condition"] in ("bad_data", "absorbed", *SEVERAL):
            continue
        truth = effect_id(row["truth"][0]) if row["truth"] else "nothing"
        names = found_names(row)
        if not names or row["verdict"] == "unknown":
            named = row["verdict"]
        elif is_first_right(row):
            named = truth
        else:
            named = effect_id(names[0])
            named += " elsewhere" if named == truth else ""
        hidden = f"{truth} ({'removed' if row['condition'] in REMOVED else 'outside'})"
        table[hidden if row["condition"] in (*REMOVED, "outside") else truth][named] += 1
    # Those that have no name to be given come last.
    return dict(sorted(table.items(), key=lambda item: ("(" in item[0], item[0])))


def write_figures(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Writes ``confusion.svg`` and ``reliability.svg``.

    Args:
        rows: Rows that were judged.
        folder: Where to.
    """
    written = []
    with theme():
        table, bins = confusion(rows), reliability(rows)
        if table:
            written.append(save_figure(_confusion_figure(table), folder / "confusion.svg"))
        if bins:
            written.append(save_figure(_reliability_figure(bins), folder / "reliability.svg"))
    return written


def _confusion_figure(table: dict[str, Counter[str]]) -> Figure:
    """Draws shares of each truth; columns in the order of the rows, verdicts last."""
    said = {name for named in table.values() for name in named}
    verdicts = [name for name in ("none", "ambiguous", "unknown") if name in said]
    columns = sorted(said - set(verdicts), key=lambda name: (name not in table, name)) + verdicts
    counts = np.array([[named[name] for name in columns] for named in table.values()])
    shares = counts / counts.sum(1, keepdims=True)
    size = (2.5 + 0.24 * len(columns), 1.8 + 0.2 * len(table))
    figure = Figure(figsize=size, layout="constrained")
    axis = figure.subplots()
    axis.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in zip(*np.nonzero(counts), strict=True):
        color = "white" if shares[row, column] > 0.5 else "black"
        axis.text(column, row, str(counts[row, column]), ha="center", va="center", color=color)
    axis.set_xticks(range(len(columns)), [n.replace("_", " ") for n in columns], rotation=90)
    axis.set_yticks(range(len(table)), [n.replace("_", " ") for n in table])
    axis.set_xlabel("named first, or the verdict")
    axis.set_ylabel("hidden")
    return figure


def _reliability_figure(bins: Sequence[Bin]) -> Figure:
    """Draws how often names were right against their probability, with 95 % intervals."""
    figure = Figure(figsize=(3.4, 3.2), layout="constrained")
    axis = figure.subplots()
    axis.plot([0.0, 1.0], [0.0, 1.0], color=COLORS["prior"], ls="--", lw=1.0)
    for part in bins:
        low, high = part.right.interval
        axis.plot([part.mean, part.mean], [low, high], color=COLORS["posterior"], lw=1.0)
        axis.plot(part.mean, part.right.value, "o", color=COLORS["posterior"], ms=4.0)
        axis.annotate(
            str(part.right.total),
            (part.mean, part.right.value),
            xytext=(4, -9),
            textcoords="offset points",
            fontsize=7,
        )
    axis.set_xlabel("probability reported")
    axis.set_ylabel("share that was right")
    axis.set_title(f"expected calibration error {calibration_error(bins):.3f}")
    return figure
