"""What one row of the benchmark of whole arms says, and the summary of all rows.

A finding is right if its name is a hidden effect's, if it reports that it could be that one with a
probability of at least 0.05, or if the hidden effect is in its class of equivalent causes and acts
at the same joints. A case is right if every hidden effect has its finding, and no other effect is
named. If the catalogue has no entry for what is hidden, the right verdict is "unknown".
"""

import json
from collections.abc import Iterable, Sequence
from itertools import permutations
from pathlib import Path
from statistics import median
from typing import Any

from clean_fits_summary import Line, Rate
from discovery_rows import CONFIDENT, Row, effect_id, large_effects, right_sets, stands_for

__all__ = [
    "MEBIBYTE",
    "is_false_alarm",
    "is_right",
    "is_wrong_without_doubt",
    "judged",
    "lines",
    "one_device",
    "print_summary",
    "told",
]

NAMING = ("named", "ambiguous")
"""Verdicts that name effects."""

ENDINGS = ("_servo", "_torque", "_velocity")
"""What ports of a joint have behind its name."""

_RATE = "_velocity"

MEBIBYTE = 2.0**20


def one_device(name: str) -> str:
    """Returns a port, or an effect with it, with each sensor's channels as one.

    An encoder's position and the speed that follows from it have one name, the position's.
    """
    port, dot, effect = name.rpartition(".") if "." in name else (name, "", "")
    channels = port.split(",")
    positions = {c + _RATE for c in channels}
    measured = [c for c in channels if c not in positions]
    return ",".join(measured) + dot + effect


def joints_of(port: str) -> frozenset[str]:
    """Returns the joints at which a port is."""
    found = set()
    for channel in port.split(","):
        for ending in ENDINGS:
            channel = channel.removesuffix(ending)
        found.add(channel)
    return frozenset(found)


def is_finding_right(finding: Row, name: str) -> bool:
    """Returns whether a finding stands for an effect at its own port."""
    port, own = name.rpartition(".")[0], one_device(finding["port"])
    alternatives: dict[str, float] = {}
    for other, probability in finding["alternatives"].items():
        other = one_device(other)
        alternatives[other] = alternatives.get(other, 0.0) + probability
    is_there = joints_of(port) == joints_of(own)
    equivalent = finding["equivalent_to"] if is_there else []
    read = finding | {"port": own, "alternatives": alternatives, "equivalent_to": equivalent}
    return stands_for(read, one_device(name))


def is_failed(row: Row) -> bool:
    """Returns whether a case had no verdict: it failed, or did not end in time."""
    return bool(row["message"])


def is_right(row: Row) -> bool:
    """Returns whether what is hidden was named, and nothing else; of nothing, that nothing is."""
    if is_failed(row):
        return False
    if not row["truth"]:
        return row["verdict"] == "none"
    if not row["is_in_catalogue"]:
        return row["verdict"] == "unknown"
    found = large_effects(row)
    return row["verdict"] in NAMING and any(
        len(right) == len(found)
        and any(
            all(is_finding_right(*pair) for pair in zip(chosen, right, strict=True))
            for chosen in permutations(found)
        )
        for right in right_sets(row)
    )


def is_wrong_without_doubt(row: Row) -> bool:
    """Returns whether an effect was named without doubt that stands for nothing hidden."""
    if is_failed(row) or row["verdict"] != "named":
        return False
    names = {name for right in right_sets(row) for name in right}
    return any(
        finding["probability"] >= CONFIDENT
        and not any(is_finding_right(finding, name) for name in names)
        for finding in large_effects(row)
    )


def is_false_alarm(row: Row) -> bool:
    """Returns whether something is said to be missing where nothing is hidden."""
    return not is_failed(row) and not row["truth"] and row["verdict"] != "none"


def judged(row: Row) -> Row:
    """Returns what a row's answer is worth."""
    return {
        "is_right": is_right(row),
        "is_wrong_without_doubt": is_wrong_without_doubt(row),
        "is_false_alarm": is_false_alarm(row),
    }


def lines(rows: Sequence[Row]) -> list[Line]:
    """Returns every target with what was measured.

    Args:
        rows: Rows of cases that could be made.
    """
    hidden = [row for row in rows if row["truth"]]
    nothing = [row for row in rows if not row["truth"]]
    result = [
        _rate("one or two effects: right, nothing else named", hidden, is_right, least=0.95),
        *(
            _rate(f"… {number}", [r for r in hidden if r["condition"] == number], is_right)
            for number in ("one", "two")
        ),
        _rate("wrong without doubt", rows, is_wrong_without_doubt, most=0.02),
        _rate("nothing hidden: false alarms", nothing, is_false_alarm, most=0.05),
        _rate("no verdict: failed, or not in time", rows, is_failed, most=0.0),
    ]
    minutes = [row["seconds"] / 60.0 for row in rows]
    if rows:
        peak = max(row["peak_mib"] for row in rows) / 1024.0
        cpu = median(row["cpu_seconds"] for row in rows) / 60.0
        worst = f"{max(minutes):.3g} min"
        result += [
            Line("median time", f"{median(minutes):.3g} min", "≤ 6 min", median(minutes) <= 6.0),
            Line("worst time", worst, "≤ 10 min", max(minutes) <= 10.0),
            Line("median time of all cores", f"{cpu:.3g} min"),
            Line("greatest memory", f"{peak:.3g} GiB", "≤ 4 GiB", peak <= 4.0),
        ]
    return result


def print_summary(file: Path) -> None:
    """Prints the targets, the kinds of effects, and the cases that went wrong."""
    every = [json.loads(line) for line in file.read_text().splitlines()]
    rows = [row for row in every if "unmade" not in row]
    print(f"{len(rows)} cases judged, {len(every) - len(rows)} could not be made")
    print("\n| figure | measured | target | met |\n|" + "---|" * 4)
    for line in lines(rows):
        print(line.markdown())
    print("\n| hidden | cases | right |\n|---|---|---|")
    for kind in sorted({kind for row in rows for kind in _ids(row["truth"])}):
        own = [row for row in rows if kind in _ids(row["truth"])]
        print(f"| {kind} | {len(own)} | {Rate.of(map(is_right, own))} |")
    print()
    for row in rows:
        if not is_right(row):
            print(told(row))


def told(row: Row) -> str:
    """Returns a row in a line."""
    where = f"{row['arm']} {row['condition']} {row['seed']}"
    if "unmade" in row:
        return f"{where}: {row['unmade']}"
    d = ", ".join(f"{value:.0f}" for value in row["separations"])
    truth = f"{' + '.join(row['truth'])}, d {d}" if row["truth"] else "nothing"
    took = f"{row['seconds']:.0f} s, {row['cpu_seconds']:.0f} s of all cores, "
    took += f"{row['peak_mib']:.0f} MiB"
    if is_failed(row):
        return f"{where}: {truth} → {row['message']} ({took})"
    named = ", ".join(
        f"{e['port']}.{e['effect']} {e['share']:.0%}, p {e['probability']:.2f}"
        for e in large_effects(row)
    )
    mark = "right" if is_right(row) else "not right"
    mark += ", WRONG WITHOUT DOUBT" if is_wrong_without_doubt(row) else ""
    return f"{where}: {truth} → {row['verdict']} [{named}], {mark} ({took})"


def _ids(names: Iterable[str]) -> set[str]:
    """Returns the effects of names; one that acts at several ports is marked."""
    return {effect_id(name) + (" of all" if "," in name else "") for name in names}


def _rate(
    label: str,
    rows: Sequence[Row],
    is_hit: Any,
    *,
    least: float | None = None,
    most: float | None = None,
) -> Line:
    rate = Rate.of(map(is_hit, rows))
    target = f"≥ {least:.0%}" if least is not None else f"≤ {most:.0%}" if most is not None else ""
    is_met = None
    if rate.total and target:
        is_met = (least is None or rate.value >= least) and (most is None or rate.value <= most)
    return Line(label, str(rate), target, is_met)
