"""What all result tables on the terminal share."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape

__all__ = [
    "UNITLESS",
    "WIDTH",
    "broken",
    "console_for_tables",
    "percent",
    "print_notes",
    "print_preparation",
    "print_reason",
]

WIDTH = 100
"""Width in characters of a table that is written to a file or a pipe."""

UNITLESS = (
    "RMSE and DTW have no unit: each channel is divided by its largest measured value. The RMSE "
    "is a mean over channels; the DTW distance is a sum over steps."
)
"""What the metrics of rollouts mean."""


def console_for_tables() -> Console:
    """Returns the terminal, or a file or pipe as a console of ``WIDTH`` characters."""
    console = Console()
    # Without a terminal, rich assumes 80 columns, which would split numbers.
    return console if console.is_terminal else Console(width=WIDTH)


def broken(name: str, width: int) -> str:
    """Returns a name with line breaks behind underscores and dots, where it is wider than a width.

    Args:
        name: The name, such as ``"shoulder_pan_joint_armature"``.
        width: Maximum width in characters; a part without underscores and dots may be wider.
    """
    lines = [""]
    for part in re.findall(r"[^_.]*[_.]|[^_.]+", name):
        if lines[-1] and len(lines[-1] + part) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def print_reason(console: Console, what: str, reason: str) -> None:
    """Prints what happened in bold, and the reason or result behind it."""
    console.print(f"[bold]{escape(what)}[/bold]: {escape(reason)}", highlight=False)


def print_preparation(console: Console, result: Mapping[str, Any]) -> None:
    """Prints the notes of the recording and how it was prepared, if inference got one."""
    if result.get("preparation") is not None:
        print_notes(console, result["preparation"]["recording"])
        console.print(result["preparation"]["sentence"], highlight=False)


def print_notes(console: Console, notes: Iterable[str]) -> None:
    """Prints what was found in a recording and how it was read, a line each."""
    for note in notes:
        print_reason(console, "recording", note)


def percent(value: float | None) -> str:
    """Returns a share in percent; a dash for ``None``."""
    return "–" if value is None else f"{value:.0%}"
