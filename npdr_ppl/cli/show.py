"""Result tables on the terminal."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from npdr_ppl.drawing.numbers import number

__all__ = [
    "show_comparison",
    "show_demo",
    "show_discovery",
    "show_fit",
    "show_missing_effect",
    "show_plan",
    "show_rows",
    "show_training",
]

FIGURES = {"mean": 9, "sd": 7, "94 % HDI": 21, "most likely": 11, "contraction": 11}
"""Numeric columns and their widths in characters."""

WORTH_TELLING = 0.1
"""The encoder resolution is printed if it causes more than this share of a channel's remaining
variance."""

MOST_ROWS = 10
"""Maximum number of rows of a ranking."""

WIDEST_NAME = 29
"""Maximum width of the column with effect names, in characters."""

WIDTH = 100
"""Width in characters of a table that is written to a file or a pipe."""


def show_fit(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``fit.json``."""
    console = _console()
    table = Table(title=f"Posterior ({result['backend']})", box=SIMPLE)
    # Long names of effects' parameters are folded; numbers are never cut.
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
    _print_preparation(console, result)
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
            _print_reason(console, f"{label} failed", row["error"])
    _print_preparation(console, result)
    console.print(f"Results and figures are in {out}/")


def show_discovery(found: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``discovery.json``, up to the last finished stage."""
    console = _console()
    _print_notes(console, (*found["data_problems"], *found.get("remarks", ())))
    if "verdict" in found:
        _show_findings(console, found)
    elif "alarm" in found:
        _show_candidates(console, found)
    elif "where" in found:
        _show_worst(console, found["where"])
    elif not found["data_problems"]:
        console.print("The data checks found no problem in the recording.")
    console.print(f"Results and figures are in {out}/")


def _show_findings(console: Console, found: Mapping[str, Any]) -> None:
    # Not at the top: other commands show their results without them.
    from npdr_ppl.discovery.proof.estimated_anew import ANEW
    from npdr_ppl.discovery.search.parts import missing_where

    if found["effects"]:
        table = Table(title="Missing effects", box=SIMPLE, padding=(0, 1, 0, 0))
        width = min(WIDEST_NAME, max(len(f"at {row['port']}") for row in found["effects"]))
        table.add_column("effect", overflow="fold", min_width=width)
        table.add_column("parameter", overflow="fold")
        for column, wide in {"prob.": 5, "mean": 10, "sd": 7, "94 % HDI": 21}.items():
            table.add_column(column, justify="right", no_wrap=True, min_width=wide)
        for row in found["effects"]:
            name, probability = f"{row['effect']}\nat {row['port']}", _percent(row["probability"])
            for parameter, p in row["parameters"].items():
                unit = "" if p["unit"] in ("", "1") else f" [{p['unit']}]"
                low, high = p["hdi_94"]
                table.add_row(
                    escape(name),
                    escape(parameter + unit),
                    probability,
                    number(p["mean"], ".4g"),
                    number(p["sd"], ".2g"),
                    f"{number(low, '.3g')} … {number(high, '.3g')}",
                )
                name = probability = ""
            for constant, value in row.get("constants", {}).items():
                table.add_row("", escape(constant), "", f"{value:.4g}", "", "")
        console.print(table)
        minor = [f"{e['port']}.{e['effect']}" for e in found["effects"] if e.get("is_minor")]
        if minor:
            console.print(f"Too small to be named, but in the model: {escape(', '.join(minor))}.")
        uncompared = [
            f"{e['port']}.{e['effect']}" for e in found["effects"] if e["probability"] is None
        ]
        if uncompared:
            console.print(f"Not compared with alternatives: {escape(', '.join(uncompared))}.")
        for effect in found["effects"]:
            parts = {part["part"]: part["is_found"] for part in effect.get("found_in") or []}
            if not all(parts.values()):
                name, where = f"{effect['port']}.{effect['effect']}", missing_where(parts)
                console.print(f"{escape(name)} was not found in {where}.")
    if found.get("learned"):
        _show_learned(console, found["learned"])
    if found["gap"]:
        table = Table(title="Held-out rollouts", box=SIMPLE)
        table.add_column("metric", no_wrap=True)
        for column in ("before", "after", "noise floor", "closed"):
            table.add_column(column, justify="right", no_wrap=True)
        for metric, gap in found["gap"].items():
            values = [number(gap[k], ".4g") for k in ("before", "after", "noise_floor")]
            table.add_row(metric, *values, number(gap["closed"], ".0%"))
        console.print(table)
    for site, values in (found.get("estimated_anew") or {}).items():
        searched, first, second = (f"{values[key]:.4g}" for key in ANEW)
        console.print(
            f"{escape(site)} was estimated anew on the held-out rollouts: {first} and {second} in "
            f"their halves, {searched} in the recording.",
            highlight=False,
        )
    if found.get("preparation") is not None:
        console.print(found["preparation"]["sentence"], highlight=False)
    _print_reason(console, found["verdict"], found["reason"])
    if found["remainder"]["fired"] and found["verdict"] != "unknown":
        share = found["remainder"]["unexplained"]
        console.print(f"A smaller misfit remains: {share:.2%} of the disagreement.")
    for channel, count in found["counts"].items():
        if count["share"] > WORTH_TELLING:
            console.print(
                f"{escape(channel)} has an encoder resolution of {count['size']:.3g}, which "
                f"causes {count['share']:.0%} of the remaining variance."
            )
    if (experiment := found["next_experiment"]) is not None:
        _print_reason(console, "next experiment", _advice(experiment))


def _show_learned(console: Console, learned: Mapping[str, Any]) -> None:
    """Prints the learned laws, what they depend on, and where they were checked."""
    title = "Learned law" if learned["offered"] else "Learned law, not offered"
    table = Table(title=title, box=SIMPLE)
    table.add_column("port", no_wrap=True)
    table.add_column("law", overflow="fold")
    table.add_column("unit", no_wrap=True)
    for law in learned["laws"]:
        table.add_row(escape(law["port"]), escape(law["with_numbers"]), escape(law["unit"]))
    console.print(table)
    for law in learned["laws"]:
        port = law["port"]
        for letter, about in law.get("letters", {}).items():
            console.print(f"{escape(letter)} is {escape(about)}.")
        shares = learned["depends_on"].get(port, {})
        words = ", ".join(f"{symbol} {share:.0%}" for symbol, share in shares.items())
        if words:
            console.print(f"Explained misfit lost at {escape(port)} without {words}.")
        if (like := learned["alike"].get(port)) is not None:
            console.print(
                f"Most similar at {escape(port)}: {escape(like['effect'])}, "
                f"correlation {like['correlation']:.2f}."
            )
    table = Table(title="Misfit where the law was not fitted", box=SIMPLE)
    table.add_column("measurements", overflow="fold")
    for column in ("without the law", "with the law"):
        table.add_column(column, justify="right", no_wrap=True)
    for check in learned["checks"]:
        before, after = number(check["before"], ".4g"), number(check["after"], ".4g")
        table.add_row(check["where"], before, after)
    console.print(table)


def _advice(experiment: Mapping[str, Any]) -> str:
    """Returns a next experiment in a sentence."""
    words = experiment["separated_by"]
    if experiment["excitation"] is None:
        return words or "none of the tried excitations separates the alternatives."
    kind = experiment["excitation"]
    limits = ", ".join(f"{name} up to {v:.3g}" for name, v in experiment["amplitude"].items())
    sentence = (
        f"{kind.replace('_', ' ')} with {limits}, which separates the alternatives by "
        f"{experiment['separations'][kind]:.0f} standard deviations"
    )
    return f"{sentence}; {words}" if words else f"{sentence}."


def _show_candidates(console: Console, found: Mapping[str, Any]) -> None:
    table = Table(title="Candidate effects for the present model", box=SIMPLE)
    table.add_column("effect", overflow="fold")
    for column in ("separation", "absorbed", "p"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in found["ranking"][:MOST_ROWS]:
        table.add_row(
            escape(f"{row['port']}.{row['effect']}"),
            f"{row['separation']:.1f}",
            f"{row['absorbed']:.0%}",
            f"{row['p_value']:.2g}",
        )
    console.print(table)
    alarm = found["alarm"]
    word = "alarm" if alarm["fired"] else "no alarm"
    console.print(f"[bold]{word}[/bold], p = {alarm['p_value']:.2g}", highlight=False)


def _show_worst(console: Console, where: Sequence[Mapping[str, Any]]) -> None:
    table = Table(title="Windows that the model misses most", box=SIMPLE)
    for column in ("rollout", "seconds", "z"):
        table.add_column(column, justify="right", no_wrap=True)
    for column in ("channel", "conditions"):
        table.add_column(column, overflow="fold")
    for row in where:
        begin, end = row["time_span"]
        table.add_row(
            str(row["rollout"]),
            f"{begin:.2f} … {end:.2f}",
            number(row["z"], ".1f"),
            escape(row["channel"]),
            escape(row["region"]),
        )
    console.print(table)


def show_training(result: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``train.json``, a row for each iteration."""
    console = _console()
    table = Table(title="Returns on the target and in simulation", box=SIMPLE)
    table.add_column("iteration", justify="right", no_wrap=True)
    table.add_column("real return", justify="right", no_wrap=True)
    table.add_column("decision", no_wrap=True)
    table.add_column("action", no_wrap=True)
    # Return of the policy that this iteration trained; the next iteration runs it.
    table.add_column("simulated return", justify="right", no_wrap=True)
    for iteration, row in enumerate(result["iterations"], start=1):
        table.add_row(
            str(iteration),
            _spread(row["real_returns"]),
            "\n".join(decision["decision"] for decision in row["decisions"]),
            "\n".join(decision["action"] for decision in row["decisions"]),
            number(row.get("sim_return"), ".0f"),
        )
    console.print(table)
    last = result["iterations"][-1]
    _print_preparation(console, last)
    _print_reason(console, last["decision"], last["reason"])
    for check in last.get("checks", [])[-1:]:
        _print_reason(console, check["decision"], check["reason"])
    console.print(f"Results and figures are in {out}/")


def _print_preparation(console: Console, result: Mapping[str, Any]) -> None:
    """Prints the notes of the recording and how it was prepared, if inference got one."""
    if result.get("preparation") is not None:
        _print_notes(console, result["preparation"]["recording"])
        console.print(result["preparation"]["sentence"], highlight=False)


def _print_notes(console: Console, notes: Iterable[str]) -> None:
    """Prints what was found in a recording and how it was read, a line each."""
    for note in notes:
        _print_reason(console, "recording", note)


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
        _print_reason(_console(), f"{what} skipped", reason)


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"


def show_demo(result: Mapping[str, Any]) -> None:
    """Prints the content of ``demo.json`` in the order of events."""
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
        share = _percent(effect["probability"])
        what = f"{effect['effect']} at {effect['port']}, {share}"
        _print_reason(console, what, values)
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
    console = _console()
    console.print(table)
    for what in ("skipped", "failed"):
        for method, reason in result.get(what, {}).items():
            _print_reason(console, f"{method} {what}", reason)


def show_plan(found: Mapping[str, Any], out: Path) -> None:
    """Prints the separations or widths before and after a planned recording."""
    console = _console()
    table = Table(box=SIMPLE)
    if found["separations"]:
        table.title = "Separation of causes, in standard deviations of the measurements"
        table.add_column("cause", overflow="fold")
        table.add_column("other cause", overflow="fold")
        rows = [(pair["one"], pair["other"], pair) for pair in found["separations"]]
        digits = ".1f"
    else:
        table.title = "Standard deviation of parameters, as a share of the prior's"
        table.add_column("parameter", overflow="fold")
        rows = [(width["name"], width) for width in found["widths"]]
        digits = ".2g"
    # Short, so that the names of causes are not broken.
    for column in ("so far", "planned", "random"):
        table.add_column(column, justify="right")
    for *names, values in rows:
        figures = (values["before"], values["after"], values["random"])
        table.add_row(*map(escape, names), *(format(figure, digits) for figure in figures))
    console.print(table)
    console.print(_told_by_plan(found), highlight=False)
    starts = [
        ", ".join(f"{name} {value:.4g}" for name, value in values.items())
        for values in found["starts"]
    ]
    if len(set(starts)) == 1:
        console.print(f"Start at rest at {escape(starts[0])}.", highlight=False)
    else:
        for index, start in enumerate(starts):
            console.print(f"Start rollout {index} at rest at {escape(start)}.", highlight=False)
    if found["has_stopped"]:
        console.print("The time limit ended the search; a longer --search-time may find more.")
    rollouts = f"{found['rollouts']} rollouts of " if found["rollouts"] > 1 else ""
    console.print(
        f"The commands for {rollouts}{found['duration']:.4g} s are in {escape(str(out))}",
        highlight=False,
    )


_LIMITS = {
    "commands": "commands",
    "channels": "positions and speeds",
    "bandwidth": "bandwidth",
}
"""Kinds of limits, in words."""

_LEAST_GAIN = 0.1
"""Gain of chance from which wider limits are recommended; the chances have standard errors of
0.025."""


def _told_by_plan(found: Mapping[str, Any]) -> str:
    """Returns the result in a sentence or more."""
    outlook = found["outlook"]
    if outlook is None:
        return f"Expected information: {found['information']:.1f} nats."
    right, wrong, random = (
        f"{outlook[key]:.0%}"
        for key in (
            "chance_of_the_right_name",
            "chance_of_a_wrong_name",
            "random_chance_of_the_right_name",
        )
    )
    told = (
        f"With this recording, npdr discover is expected to name the right cause in {right} of "
        f"such cases, and a wrong one in {wrong}; with random commands the right one in {random}."
    )
    wanted, needed = outlook["wanted_chance"], outlook["needed_rollouts"]
    if outlook["chance_of_the_right_name"] >= wanted:
        return told
    if needed is None:
        most = outlook["most_needed_rollouts"]
        told = f"{told} Within these limits, even {most} rollouts do not suffice for {wanted:.0%}."
    else:
        told = f"{told} For {wanted:.0%}, about {needed} rollouts are needed: --rollouts {needed}."
    # A short search finds less than the plan did, so only what exceeds it is an advice.
    better = {
        limit: f"up to twice the {_LIMITS[limit]}: {chance:.0%}"
        for limit, chance in outlook["with_twice_the"].items()
        if chance > outlook["chance_of_the_right_name"] + _LEAST_GAIN
    }
    if better:
        return f"{told} With {', with '.join(better.values())}."
    if outlook["with_twice_the"]:
        return f"{told} A short search within limits up to twice as wide found nothing better."
    return told


def _console() -> Console:
    console = Console()
    # Without a terminal, rich assumes 80 columns, which would split numbers.
    return console if console.is_terminal else Console(width=WIDTH)


def _print_reason(console: Console, what: str, reason: str) -> None:
    console.print(f"[bold]{escape(what)}[/bold]: {escape(reason)}", highlight=False)


def _spread(values: Sequence[float]) -> str:
    """Returns the mean of some values, with their standard deviation if there are several."""
    middle = f"{mean(values):.0f}"
    return f"{middle} ± {stdev(values):.0f}" if len(values) > 1 else middle


def _figure(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    spread = f" ± {value['std']:.2g}" if value["std"] else ""
    return f"{value['mean']:.4g}{spread}"
