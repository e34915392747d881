"""Result tables on the terminal."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

__all__ = ["show_comparison", "show_demo", "show_fit", "show_rows", "show_training"]

FIGURES = {"mean": 9, "sd": 7, "94 % HDI": 21, "most likely": 11, "contraction": 11}
"""Columns of figures with the width they need."""

WIDTH = 100
"""Columns of a table that is written to a file or a pipe."""


def show_fit(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``fit.json``."""
    console = _console()
    table = Table(title=f"Posterior ({result['backend']})", box=SIMPLE)
    # Long names of effects' parameters are folded; figures stay whole.
    table.add_column("parameter", overflow="fold")
    for column, width in FIGURES.items():
        table.add_column(column, justify="right", no_wrap=True, min_width=width)
    contraction = result["diagnosis"]["contraction"]
    for name, p in result["parameters"].items():
        table.add_row(
            name,
            f"{p['mean']:.4g}",
            f"{p['sd']:.2g}",
            f"{p['hdi_94'][0]:.4g} … {p['hdi_94'][1]:.4g}",
            f"{result['most_likely'][name]:.4g}",
            f"{contraction[name]:.0%}",
        )
    console.print(table)
    metrics, seconds = result["metrics"], result["seconds"]
    console.print(
        f"RMSE {metrics['rmse']:.3f}, DTW {metrics['dtw']:.0f} on {metrics['evaluated_on']} "
        f"rollouts (most likely draw); simulate {seconds['simulate']:.1f} s, "
        f"train {seconds['train']:.1f} s, sample {seconds['sample']:.1f} s"
    )
    console.print(
        f"[bold]{result['diagnosis']['decision']}[/bold]: {result['diagnosis']['reason']}"
    )
    console.print(f"Results and figures are in {out}/")


def show_comparison(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``comparison.json``, the best backend first."""
    console = _console()
    settings, rows = result["settings"], result["backends"]
    table = Table(
        title=f"{settings['rounds'] * settings['num_simulations']} simulations each, judged by "
        f"{settings['evaluated_on']} data",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    table.add_column("backend", overflow="fold")
    for column in ("elpd", "behind", "weight", "RMSE", "DTW", "CRPS", "r-hat"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("50/80/95 %", justify="right", no_wrap=True)
    table.add_column("time", justify="right", no_wrap=True)
    table.add_column("decision", overflow="fold")
    for label in result["ranking"]:
        row = rows[label]
        behind = row["elpd_difference"]
        table.add_row(
            escape(label),
            _number(row["elpd"], ".1f"),
            "–" if not behind else f"{behind:.1f} ± {row['elpd_difference_se']:.1f}",
            _number(row["weight"], ".2f"),
            _number(row["rmse"], ".3f"),
            _number(row["dtw"], ".0f"),
            _number(row["crps"], ".4f"),
            _number(row["r_hat"], ".2f"),
            " ".join(_number(share, ".0%")[:-1] for share in row["coverage"].values()),
            f"{sum(row['seconds'].values()):.0f} s",
            row["decision"],
        )
    console.print(table)
    for label, row in rows.items():
        if row["error"] is not None:
            _print_reason(console, f"{label} failed", row["error"])
    console.print(f"Results and figures are in {out}/")


def show_training(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``train.json``, a row for each iteration."""
    console = _console()
    table = Table(title="Returns on the target and in simulation", box=SIMPLE)
    table.add_column("iteration", justify="right", no_wrap=True)
    table.add_column("real return", justify="right", no_wrap=True)
    table.add_column("decision", no_wrap=True)
    table.add_column("what the loop did", no_wrap=True)
    # Of the policy that the iteration trained, which the next one runs.
    table.add_column("simulated return", justify="right", no_wrap=True)
    for number, row in enumerate(result["iterations"], start=1):
        table.add_row(
            str(number),
            _spread(row["real_returns"]),
            "\n".join(decision["decision"] for decision in row["decisions"]),
            "\n".join(decision["action"] for decision in row["decisions"]),
            _number(row.get("sim_return"), ".0f"),
        )
    console.print(table)
    last = result["iterations"][-1]
    _print_reason(console, last["decision"], last["reason"])
    console.print(f"Results and figures are in {out}/")


def show_demo(result: Mapping[str, Any]) -> None:
    """Prints the content of ``demo.json`` as a story."""
    console = _console()
    before, after = result["returns"].values()
    console.print(f"The policy from the prior earns {before:.0f} on the rig.")
    for row in result["decisions"]:
        _print_reason(console, row["decision"], row["reason"])
    for effect in result["effects"]:
        values = ", ".join(
            f"{name} {row['mean']:.3g} {row['unit']}"
            for name, row in effect["parameters"].items()
            if row["mean"] is not None
        )
        share = f"{effect['probability']:.0%}"
        what = f"{effect['effect']} at {effect['port']}, {share}"
        _print_reason(console, what, values)
    console.print(
        f"The policy from the revised model earns {after:.0f}; above {result['success']:.0f} the "
        "pole is swung up and balanced."
    )


def show_rows(title: str, result: Mapping[str, Any]) -> None:
    """Prints the content of a reproduction's JSON: ours beside the paper's."""
    table = Table(title=title, box=SIMPLE)
    metrics = list(dict.fromkeys(m for row in result["rows"].values() for m in row))
    published = {m for row in result["paper"].values() for m in row}
    table.add_column("method", no_wrap=True)
    for metric in metrics:
        table.add_column(metric, justify="right", no_wrap=True)
        if metric in published:
            table.add_column(f"{metric}, paper", justify="right", no_wrap=True)
    for method, row in result["rows"].items():
        cells = [escape(method)]
        for metric in metrics:
            cells.append(_figure(row.get(metric)))
            if metric in published:
                cells.append(_figure(result["paper"].get(method, {}).get(metric)))
        table.add_row(*cells)
    console = _console()
    console.print(table)
    for what in ("skipped", "failed"):
        for method, reason in result.get(what, {}).items():
            _print_reason(console, f"{method} {what}", reason)


def _console() -> Console:
    console = Console()
    # Without a terminal rich assumes 80 columns, which would cut numbers in two.
    return console if console.is_terminal else Console(width=WIDTH)


def _print_reason(console: Console, what: str, reason: str) -> None:
    console.print(f"[bold]{escape(what)}[/bold]: {escape(reason)}", highlight=False)


def _number(value: float | None, format_spec: str) -> str:
    return "–" if value is None or not math.isfinite(value) else format(value, format_spec)


def _spread(values: Sequence[float]) -> str:
    """Returns the mean of some values, and their standard deviation if they are several."""
    middle = f"{mean(values):.0f}"
    return f"{middle} ± {stdev(values):.0f}" if len(values) > 1 else middle


def _figure(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    spread = f" ± {value['std']:.2g}" if value["std"] else ""
    return f"{value['mean']:.4g}{spread}"
