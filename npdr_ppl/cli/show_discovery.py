"""The results of a discovery on the terminal, up to the stage that it reached."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from npdr_ppl.cli.printing import (
    UNITLESS,
    broken,
    console_for_tables,
    percent,
    print_notes,
    print_reason,
)
from npdr_ppl.drawing.effect_names import why_unnamed
from npdr_ppl.drawing.experiment_words import ranges_of_commands, values_that_differ
from npdr_ppl.drawing.numbers import interval, number, uncertain

__all__ = ["show_discovery"]

WORTH_TELLING = 0.1
"""The encoder resolution is printed if it causes more than this share of a channel's remaining
variance."""

MOST_ROWS = 10
"""Maximum number of rows of a ranking."""

WIDEST_NAME = 29
"""Maximum width of the column with effect names, in characters."""

WIDEST_PARAMETER = 36
"""Maximum width of the column with names of parameters, in characters; the others need 62."""

MOST_PARAMETERS = 25
"""Maximum number of rows of the table of parameters, so that it fits a screen."""


def show_discovery(found: Mapping[str, Any], out: Path) -> None:
    """Prints the content of ``discovery.json``, up to the last finished stage."""
    console = console_for_tables()
    print_notes(console, (*found["data_problems"], *found.get("remarks", ())))
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
    from npdr_ppl.discovery.headline import told_doubt
    from npdr_ppl.discovery.proof.estimated_anew import ANEW

    if found["effects"]:
        table = Table(title="Effects in the revised model", box=SIMPLE, padding=(0, 1, 0, 0))
        width = min(WIDEST_NAME, max(len(f"at {row['port']}") for row in found["effects"]))
        table.add_column("effect", overflow="fold", min_width=width)
        table.add_column("parameter", overflow="fold")
        for column, wide in {"prob.": 5, "mean": 10, "sd": 7, "94 % HDI": 21}.items():
            table.add_column(column, justify="right", no_wrap=True, min_width=wide)
        for row in found["effects"]:
            name, probability = f"{row['effect']}\nat {row['port']}", percent(row["probability"])
            for parameter, p in row["parameters"].items():
                unit = "" if p["unit"] in ("", "1") else f" [{p['unit']}]"
                table.add_row(
                    escape("\n".join(broken(line, WIDEST_NAME) for line in name.split("\n"))),
                    escape(parameter + unit),
                    probability,
                    uncertain(p["mean"], p["sd"]),
                    number(p["sd"], ".2g"),
                    interval(p["hdi_94"], least=3),
                )
                name = probability = ""
            for constant, value in row.get("constants", {}).items():
                table.add_row("", escape(constant), "", f"{value:.4g}", "", "")
        console.print(table)
        names = [f"{e['port']}.{e['effect']}" for e in found["effects"]]
        labelled = list(zip(names, found["effects"], strict=True))
        minor = [name for name, effect in labelled if why_unnamed(effect) == "small"]
        if minor:
            console.print(f"Too small to be named, but in the model: {escape(', '.join(minor))}.")
        for name, effect in labelled:
            if effect.get("corrects"):
                told = f"{name} is not missing: it {why_unnamed(effect)}."
                console.print(escape(told), highlight=False)
        uncompared = [
            f"{e['port']}.{e['effect']}" for e in found["effects"] if e["probability"] is None
        ]
        if uncompared:
            console.print(f"Not compared with alternatives: {escape(', '.join(uncompared))}.")
        for effect in found["effects"]:
            if doubt := told_doubt(effect):
                name = f"{effect['port']}.{effect['effect']}"
                console.print(escape(f"{name} {doubt}."))
    _show_parameters(console, found)
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
        console.print(UNITLESS, highlight=False)
    for site, values in (found.get("estimated_anew") or {}).items():
        searched, first, second = (f"{values[key]:.4g}" for key in ANEW)
        console.print(
            f"{escape(site)} was estimated anew on the held-out rollouts: {first} and {second} in "
            f"their halves, {searched} in the recording.",
            highlight=False,
        )
    if found.get("preparation") is not None:
        console.print(found["preparation"]["sentence"], highlight=False)
    print_reason(console, found["verdict"], found["reason"])
    if found["remainder"]["fired"] and found["verdict"] != "unknown":
        share = f"{found['remainder']['unexplained']:.2%}"
        if float(share.rstrip("%")) > 0.0:
            console.print(f"A smaller misfit remains: {share} of the disagreement.")
    for channel, count in found["counts"].items():
        if count["share"] > WORTH_TELLING:
            console.print(
                f"{escape(channel)} has an encoder resolution of {count['size']:.3g}, which "
                f"causes {count['share']:.0%} of the remaining variance."
            )
    if (experiment := found["next_experiment"]) is not None:
        print_reason(console, "next experiment", _advice(experiment))


def _show_parameters(console: Console, found: Mapping[str, Any]) -> None:
    """Prints the parameters of the revised model, apart from those of the effects added."""
    added = tuple(f"{row['port']}.{row['effect']}." for row in found["effects"])
    rows = {
        name: row
        for name, row in found.get("parameters", {}).items()
        if not name.startswith(added)
    }
    if not rows:
        return
    which = "Other parameters of the revised model" if added else "Parameters of the model"
    table = Table(title=which, box=SIMPLE, padding=(0, 1, 0, 0))
    table.add_column("parameter", overflow="fold")
    for column in ("mean", "sd", "94 % HDI"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("unit", overflow="fold")
    for name, p in list(rows.items())[:MOST_PARAMETERS]:
        table.add_row(
            escape(broken(name, WIDEST_PARAMETER)),
            uncertain(p["mean"], p["sd"]),
            number(p["sd"], ".2g"),
            interval(p["hdi_94"]),
            "" if p["unit"] in ("", "1") else escape(p["unit"]),
        )
    console.print(table)
    if (left := len(rows) - MOST_PARAMETERS) > 0:
        console.print(f"{left} more parameters are in discovery.json.", highlight=False)


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
        ways = words or "none of the excitations that were tried separates the alternatives."
        differing = values_that_differ(experiment)
        return f"{ways.rstrip('.')}; measure {differing}." if differing else ways
    kind = experiment["excitation"]
    sentence = (
        f"{kind.replace('_', ' ')} with {ranges_of_commands(experiment)}, which separates the "
        f"alternatives by {experiment['separations'][kind]:.0f} standard deviations"
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
    console.print(
        "The effect that explains most is first. separation: distance between simulations with "
        "and without it, in standard deviations; absorbed: the share of its change that "
        "parameters explain; p: probability that chance alone explains as much.",
        highlight=False,
    )
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
