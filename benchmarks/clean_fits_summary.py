"""Summary of default fits: one row a subject, and every target with what was measured.

A rate comes with its 95 % interval after Wilson. Parameters of one fit are counted as if they were
independent, so the interval of a coverage is somewhat too narrow.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

__all__ = [
    "Line",
    "Rate",
    "is_failed",
    "is_held_or_doubted",
    "is_right_prior_named",
    "lines",
    "print_summary",
    "subject_table",
    "wilson",
]

Row = dict[str, Any]

REVISE, ACCEPT, UNFINISHED = "revise the model", "accept", ("more rounds", "stop")
"""Decisions of the diagnosis; the last ask for more computation."""

NOTHING = "none"
"""Verdict of a discovery that finds nothing missing."""

DOUBT = re.compile(r"\bdisagree|\bnot\b[^.]{0,20}\bconverged?\b", re.IGNORECASE)
"""Words of a reason that says that a posterior is not to be believed yet."""

MEBIBYTE = 2.0**20

NORMAL_95 = 1.959964
"""97.5 % quantile of the standard normal distribution."""


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Returns the 95 % interval of a rate after Wilson (1927); 0 to 1 of nothing."""
    if not total:
        return 0.0, 1.0
    rate, z2 = hits / total, NORMAL_95**2
    centre = (rate + 0.5 * z2 / total) / (1.0 + z2 / total)
    spread = math.sqrt(rate * (1.0 - rate) / total + 0.25 * z2 / total**2)
    half = NORMAL_95 * spread / (1.0 + z2 / total)
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Rate:
    """k of n."""

    hits: int
    total: int

    @classmethod
    def of(cls, found: Iterable[bool]) -> "Rate":
        """Counts."""
        values = [bool(value) for value in found]
        return cls(sum(values), len(values))

    @property
    def value(self) -> float:
        """The rate, NaN of nothing."""
        return self.hits / self.total if self.total else math.nan

    def __str__(self) -> str:
        if not self.total:
            return "–"
        low, high = wilson(self.hits, self.total)
        return (
            f"{self.hits} of {self.total} = {100 * self.value:.0f} % "
            f"({100 * low:.0f} to {100 * high:.0f})"
        )


@dataclass(frozen=True)
class Line:
    """A target with what was measured.

    Attributes:
        label: What was measured.
        shown: The figure.
        target: What was asked for; empty where nothing was.
        is_met: Whether the figure meets it; ``None`` where nothing was measured or asked for.
    """

    label: str
    shown: str
    target: str = ""
    is_met: bool | None = None

    def markdown(self) -> str:
        """Returns the line of the table."""
        met = {True: "yes", False: "no", None: "–"}[self.is_met]
        return f"| {self.label} | {self.shown} | {self.target or '–'} | {met} |"


def is_failed(row: Row) -> bool:
    """Returns whether a fit or search ended with an error, or left what cannot be read."""
    has_searched = row.get("discovery", {"exit_code": 0})["exit_code"] == 0
    return row["exit_code"] != 0 or "error" in row or not has_searched


def subject_table(rows: Sequence[Row]) -> list[str]:
    """Returns a table of fits, one row a subject and one for all."""
    head = (
        *("subject", "fits", "failed", "90 % intervals that hold the truth"),
        *("“revise the model”", "accepted", "error / truth’s", "sd / prior’s", "CPU s"),
        *("seconds", "MiB"),
    )
    result = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    subjects = list(dict.fromkeys(_label(row) for row in rows))
    for name in (*subjects, "all"):
        own = [row for row in rows if name in ("all", _label(row))]
        fits = [row for row in own if not is_failed(row)]
        cells = (
            *(name, str(len(own)), str(len(own) - len(fits)), str(_coverage(fits))),
            *(str(_decided(fits, REVISE)), str(_decided(fits, ACCEPT))),
            _number(_median(row["rmse_ratio"] for row in fits if "rmse_ratio" in row)),
            _number(_median(p["width"] for row in fits for p in row["parameters"].values())),
            _number(_median(row["cpu_seconds"] for row in own)),
            _number(_median(row["seconds"] for row in own)),
            f"{max((row['peak_bytes'] for row in own), default=0) / MEBIBYTE:.0f}",
        )
        result.append(f"| {' | '.join(cells)} |")
    return result


def lines(rows: Sequence[Row]) -> list[Line]:
    """Returns every target with what was measured.

    Args:
        rows: Rows of cases that could be made.
    """

    def of(condition: str) -> list[Row]:
        return [row for row in rows if row["condition"] == condition]

    clean = of("clean")
    fits = [row for row in clean if not is_failed(row)]
    quick = [row for row in clean if row["subject"] == "quick_start"]
    ratio = _median(row["rmse_ratio"] for row in fits if "rmse_ratio" in row)
    slowest = max((m for m in _by_subject(clean, "cpu_seconds")), default=math.nan)
    peak = max((row["peak_bytes"] for row in clean), default=math.nan) / 2**30
    blamed = _decided(fits, REVISE)
    return [
        _rate("clean: fits that failed", Rate.of(map(is_failed, clean)), "0", lambda r: r == 0.0),
        _rate(
            "clean: truth inside the 90 % interval",
            _coverage(fits),
            "85 to 95 %",
            lambda r: 0.85 <= r <= 0.95,
        ),
        _rate(
            "clean: “revise the model”",
            blamed,
            "≤ 5 %, upper end ≤ 8 %",
            lambda r: r <= 0.05 and wilson(blamed.hits, blamed.total)[1] <= 0.08,
        ),
        Line("clean: accepted", str(_decided(fits, ACCEPT))),
        _figure("clean: median held-out error / the truth’s", ratio, 1.1),
        Line(
            "clean: held-out error of fit.json reproduced",
            str(Rate.of(row["is_rmse_reproduced"] for row in fits if row.get("rmse_reported"))),
        ),
        _rate(
            "quick start: accepted",
            Rate.of(row.get("decision") == ACCEPT for row in quick),
            "≥ 90 %",
            lambda r: r >= 0.9,
        ),
        _figure("clean: median CPU seconds of the slowest subject", slowest, 60.0, " s"),
        _figure("clean: greatest peak memory", peak, 2.0, " GiB"),
        _rate(
            "clean: npdr discover finds something missing",
            Rate.of(row["discovery"]["verdict"] != NOTHING for row in _searched(clean)),
            "≤ 5 %",
            lambda r: r <= 0.05,
        ),
        Line(
            "clean: npdr discover names an effect",
            str(Rate.of(bool(row["discovery"]["effects"]) for row in _searched(clean))),
        ),
        _rate(
            "narrow: the right prior is named first",
            Rate.of(is_right_prior_named(row) for row in of("narrow")),
            "≥ 95 %",
            lambda r: r >= 0.95,
        ),
        *(
            _rate(
                f"backends, {name}: truth inside the joint 95 % region, or told in doubt",
                Rate.of(is_held_or_doubted(r) for r in of("backends") if r["variant"] == name),
                "100 %",
                lambda r: r == 1.0,
            )
            for name in dict.fromkeys(row["variant"] for row in of("backends"))
        ),
        *(
            _rate(
                f"{condition}: “revise the model”",
                Rate.of(row.get("decision") == REVISE for row in of(condition)),
                "≥ 95 %",
                lambda r: r >= 0.95,
            )
            for condition in ("friction", "weak_friction", "missing")
        ),
    ]


def is_right_prior_named(row: Row) -> bool:
    """Returns whether the reason's first parameter is the one whose prior is too narrow."""
    return row.get("named", [])[:1] == [row["narrowed"]]


def is_held_or_doubted(row: Row) -> bool:
    """Returns whether a joint 95 % region holds the truth, or the run doubts its own posterior."""
    if is_failed(row):
        return False
    is_doubted = row["decision"] in UNFINISHED or DOUBT.search(row["reason"]) is not None
    is_doubted = is_doubted and row["decision"] != ACCEPT
    return is_doubted or all(p["is_inside_jointly"] for p in row["parameters"].values())


def _searched(rows: Sequence[Row]) -> list[Row]:
    """Returns rows of which a search for missing effects has ended well."""
    return [row for row in rows if "verdict" in row.get("discovery", {})]


def print_summary(file: Path) -> None:
    """Prints the tables of a file of rows."""
    every = [json.loads(line) for line in file.read_text().splitlines()]
    rows = [row for row in every if "unmade" not in row]
    if len(rows) < len(every):
        print(f"{len(every) - len(rows)} of {len(every)} cases could not be made")
    for condition in dict.fromkeys(row["condition"] for row in rows):
        print(f"\n{condition}\n")
        print("\n".join(subject_table([row for row in rows if row["condition"] == condition])))
    print("\n| figure | measured | target | met |\n|" + "---|" * 4)
    for line in lines(rows):
        print(line.markdown())


def _label(row: Row) -> str:
    return f"{row['subject']} {row['variant']}".strip()


def _coverage(fits: Sequence[Row]) -> Rate:
    return Rate.of(p["is_inside"] for row in fits for p in row["parameters"].values())


def _decided(fits: Sequence[Row], decision: str) -> Rate:
    return Rate.of(row["decision"] == decision for row in fits)


def _by_subject(rows: Sequence[Row], figure: str) -> list[float]:
    """Returns a figure's median for every subject."""
    subjects = {row["subject"] for row in rows}
    return [_median(row[figure] for row in rows if row["subject"] == name) for name in subjects]


def _rate(label: str, rate: Rate, target: str, meets: Callable[[float], bool]) -> Line:
    return Line(label, str(rate), target, meets(rate.value) if rate.total else None)


def _figure(label: str, value: float, most: float, unit: str = "") -> Line:
    is_met = None if math.isnan(value) else value <= most
    return Line(label, f"{_number(value)}{unit}", f"≤ {most:g}{unit}", is_met)


def _median(values: Iterable[float]) -> float:
    found = list(values)
    return median(found) if found else math.nan


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"
