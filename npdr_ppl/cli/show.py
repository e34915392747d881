"""Tables of the results of inference, training and reproductions on the terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from npdr_ppl.cli.printing import (
    UNITLESS,
    broken,
    console_for_tables,
    percent,
    print_preparation,
    print_reason,
)
from npdr_ppl.cli.show_discovery import show_discovery
from npdr_ppl.drawing.numbers import interval, number, uncertain

__all__ = [
    "show_comparison",
    "show_demo",
    "show_fit",
    "show_missing_effect",
    "show_rows",
    "show_training",
]

FIGURES = {"mean": 9, "sd": 7, "94 % HDI": 21, "most likely": 11, "contraction": 11}
"""Numeric columns and their widths in characters."""

NARROWEST_NAME = 12
"""Minimum width of the column with names of parameters, in characters."""

RETURNS = (
    "Real return: of the policy that ran on the target in this iteration. Simulated return: of "
    "the policy trained in this iteration, which runs on the target in the next one; it is a mean "
    "over the simulators that the policy was trained in."
)
"""Which policies the two returns of training belong to."""


def show_fit(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``fit.json``."""
    console = console_for_tables()
    table = Table(title=f"Posterior ({result['backend']})", box=SIMPLE, padding=(0, 1, 0, 0))
    # Long names of parameters take several lines; numbers are never cut.
    width = max(NARROWEST_NAME, console.width - sum(FIGURES.values()) - 2 * (len(FIGURES) + 1))
    table.add_column("parameter", overflow="fold")
    for column, least in FIGURES.items():
        table.add_column(column, justify="right", no_wrap=True, min_width=least)
    contraction = result["diagnosis"]["contraction"]
    for name, p in result["parameters"].items():
        table.add_row(
            escape(broken(name, width)),
            uncertain(p["mean"], p["sd"]),
            f"{p['sd']:.2g}",
            interval(p["hdi_94"]),
            uncertain(result["most_likely"][name], p["sd"]),
            f"{contraction[name]:.0%}",
        )
    console.print(table)
    metrics, seconds = result["metrics"], result["seconds"]
    console.print(
        f"RMSE {number(metrics['rmse'])}, DTW {number(metrics['dtw'], '.4g')} on "
        f"{metrics['evaluated_on']} rollouts (most likely draw, simulated from the start of each "
        f"segment). {UNITLESS}",
        highlight=False,
    )
    console.print(
        f"Simulated for {seconds['simulate']:.1f} s, trained for {seconds['train']:.1f} s, "
        f"sampled for {seconds['sample']:.1f} s.",
        highlight=False,
    )
    print_preparation(console, result)
    console.print(
        f"[bold]{result['diagnosis']['decision']}[/bold]: {result['diagnosis']['reason']}"
    )
    console.print(f"Results and figures are in {out}/")


def show_comparison(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``comparison.json``, the best backend first."""
    console = console_for_tables()
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
            number(row["elpd"], ".1f"),
            "–" if not behind else f"{behind:.1f} ± {row['elpd_difference_se']:.1f}",
            number(row["weight"], ".2f"),
            number(row["rmse"], ".3f"),
            number(row["dtw"], ".0f"),
            number(row["crps"], ".4f"),
            number(row["r_hat"], ".2f"),
            " ".join(number(share, ".0%")[:-1] for share in row["coverage"].values()),
            f"{sum(row['seconds'].values()):.0f} s",
            row["decision"],
        )
    console.print(table)
    for label, row in rows.items():
        if row["error"] is not None:
            print_reason(console, f"{label} failed", row["error"])
    print_preparation(console, result)
    console.print(f"Results and figures are in {out}/")


def show_training(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``train.json``, a row for each decision of each iteration."""
    console = console_for_tables()
    table = Table(
        title="Returns on the target and in simulation",
        caption=RETURNS,
        caption_justify="left",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    table.add_column("iteration", justify="right", no_wrap=True)
    table.add_column("real\nreturn", justify="right", no_wrap=True)
    table.add_column("decision", no_wrap=True)
    table.add_column("action")
    table.add_column("simulated\nreturn", justify="right", no_wrap=True)
    for iteration, row in enumerate(result["iterations"], start=1):
        cells = [str(iteration), _spread(row["real_returns"])]
        last = len(row["decisions"]) - 1
        for index, decision in enumerate(row["decisions"]):
            simulated = number(row.get("sim_return"), ".0f") if index == last else ""
            table.add_row(*cells, decision["decision"], decision["action"], simulated)
            cells = ["", ""]
    console.print(table)
    last = result["iterations"][-1]
    print_preparation(console, last)
    print_reason(console, last["decision"], last["reason"])
    for check in last.get("checks", [])[-1:]:
        print_reason(console, check["decision"], check["reason"])
    console.print(f"Results and figures are in {out}/")


def show_missing_effect(found: Mapping[str, Any], result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``discovery.json``, then of ``missing-effect.json``."""
    show_discovery(found, out)
    tables = {
        "Held-out swing-ups": ("", {}),
        "The same from recorded states, as in the paper": ("_recorded", result["paper"]),
        "Another excitation": ("_chirp", {}),
    }
    for title, (suffix, paper) in tables.items():
        names = {metric: f"{metric}{suffix}" for metric in ("rmse", "dtw")}
        rows = {
            method: {metric: row[name] for metric, name in names.items() if name in row}
            for method, row in result["rows"].items()
        }
        if any(rows.values()):
            show_rows(title, {"rows": rows, "paper": paper})
    for what, reason in result["skipped"].items():
        print_reason(console_for_tables(), f"{what} skipped", reason)


def show_demo(result: Mapping[str, Any]) -> None:
    """Prints the content of ``demo.json`` in the order of events."""
    console = console_for_tables()
    before, after = result["returns"].values()
    console.print(f"The policy from the prior earns {before:.0f} on the rig.")
    for row in result["decisions"]:
        print_reason(console, row["decision"], row["reason"])
    for effect in result["effects"]:
        values = ", ".join(
            f"{name} {row['mean']:.3g} {row['unit']}"
            for name, row in effect["parameters"].items()
            if row["mean"] is not None
        )
        share = percent(effect["probability"])
        what = f"{effect['effect']} at {effect['port']}, {share}"
        print_reason(console, what, values)
    console.print(
        f"The policy from the revised model earns {after:.0f}; above {result['success']:.0f} the "
        "pole is swung up and balanced."
    )


def show_rows(title: str, result: Mapping[str, Any]) -> None:
    """Prints the content of a reproduction's JSON: our results next to the paper's."""
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
    console = console_for_tables()
    console.print(table)
    for what in ("skipped", "failed"):
        for method, reason in result.get(what, {}).items():
            print_reason(console, f"{method} {what}", reason)


def _spread(values: Sequence[float]) -> str:
    """Returns the mean of some values, with their standard deviation if there are several."""
    middle = f"{mean(values):.0f}"
    return f"{middle} ± {stdev(values):.0f}" if len(values) > 1 else middle


def _figure(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    spread = f" ± {value['std']:.2g}" if value["std"] else ""
    return f"{value['mean']:.4g}{spread}"
