"""The result of planning the next recording, on the terminal."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from npdr_ppl.cli.printing import console_for_tables

__all__ = ["show_plan"]

_LIMITS = {
    "commands": "commands",
    "channels": "positions and speeds",
    "bandwidth": "bandwidth",
}
"""Kinds of limits, in words."""

_LEAST_GAIN = 0.1
"""Gain of chance from which wider limits are recommended; the chances have standard errors of
0.025."""


def show_plan(found: Mapping[str, Any], out: Path) -> None:
    """Prints the separations or widths before and after a planned recording."""
    console = console_for_tables()
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
        console.print(f"Hold it at rest at {escape(starts[0])} first.", highlight=False)
    else:
        for start in dict.fromkeys(starts):
            own = [str(index) for index, other in enumerate(starts) if other == start]
            which = f"rollout{'s' * (len(own) > 1)} {', '.join(own)}"
            console.print(f"Hold it at rest at {escape(start)} before {which}.", highlight=False)
    if found["has_stopped"]:
        console.print("The time limit ended the search; a longer --search-time may find more.")
    rollouts = f"{found['rollouts']} rollouts of " if found["rollouts"] > 1 else ""
    console.print(
        f"The commands for {rollouts}{found['duration']:.4g} s are in {escape(str(out))}",
        highlight=False,
    )


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
