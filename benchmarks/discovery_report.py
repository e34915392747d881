"""Prints the results of the blind benchmark: the table, and the cases that went wrong."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from discovery_figures import confusion, reliability, write_figures
from discovery_rows import Row, found_names, is_class_right
from discovery_summary import STRONG, by_effect, summary_lines
from discovery_table import HEADING, Rate

__all__ = ["print_summary", "read_rows"]


def read_rows(path: Path) -> tuple[list[Row], list[Row]]:
    """Returns the rows of a file that were judged, and those that failed."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return [r for r in rows if "error" not in r], [r for r in rows if "error" in r]


def print_summary(path: Path, *, figures: bool = False) -> None:
    """Prints the table of a file of rows, and what went wrong.

    Args:
        path: The file.
        figures: Whether to draw the confusion matrix and the reliability too, into a folder
            beside the file that is named after it.
    """
    rows, failed = read_rows(path)
    print(f"{len(rows)} cases, {len(failed)} failed: {Counter(r['error'][:80] for r in failed)}\n")
    print(HEADING)
    for line in summary_lines(rows):
        print(line.markdown())
    _print_effects(rows)
    _print_confusion(rows)
    bins = reliability(rows)
    if bins:
        print(
            "\n| probability reported | n | mean | right | 95 % interval |\n|---|---|---|---|---|"
        )
    for part in bins:
        low, high = part.right.interval
        print(
            f"| {part.low:.2f} to {part.high:.2f} | {part.right.total} | {part.mean:.2f} | "
            f"{part.right.value:.2f} | {low:.2f} to {high:.2f} |"
        )
    if figures:
        for written in write_figures(rows, path.with_name(f"{path.stem}_figures")):
            print(f"\nwrote {written}")


def _print_effects(rows: Sequence[Row]) -> None:
    strong = [row for row in rows if row["condition"] == "one" and row["d"] >= STRONG]
    if strong:
        print("\n| effect, d ≥ 10 | n | name or class first | missed: rig, verdict, names |")
        print("|---|---|---|---|")
    for name, own in sorted(by_effect(strong).items()):
        share = Rate.of(own, is_class_right)
        missed = [row for row in own if not is_class_right(row)]
        said = "; ".join(f"{r['rig']}: {r['verdict']} {', '.join(found_names(r))}" for r in missed)
        print(f"| {name} | {share.total} | {share.value:.0%} | {said} |")


def _print_confusion(rows: Sequence[Row]) -> None:
    table = confusion(rows)
    if table:
        print("\n| hidden | n | named |\n|---|---|---|")
    for truth, named in table.items():
        said = ", ".join(f"{name} {count}" for name, count in named.most_common())
        print(f"| {truth} | {named.total()} | {said} |")
