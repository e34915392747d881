"""What the rows of the blind benchmark come to."""

import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

__all__ = ["is_class_right", "is_first_right", "print_summary"]

RATE = 0.01
"""The rate of false alarms that was asked for."""

Row = dict[str, Any]


def found_names(row: Row) -> list[str]:
    """Returns the names of the effects that were found."""
    return [f"{e['port']}.{e['effect']}" for e in row.get("effects", [])]


def right_sets(row: Row) -> list[set[str]]:
    """Returns the sets of names that count as right."""
    return [set(row["truth"]), *(set(names) for names in row.get("alternatives", []))]


def is_first_right(row: Row) -> bool:
    """Returns whether the first effect is the true one, or stands for it."""
    names = found_names(row)
    return bool(names) and any(names[0] in right for right in right_sets(row))


def is_class_right(row: Row) -> bool:
    """Returns whether the truth is the first effect or among what could stand in its place."""
    if is_first_right(row):
        return True
    if not row.get("effects"):
        return False
    alternatives = row["effects"][0]["alternatives"]
    named = {name for name, p in alternatives.items() if p >= 0.05}
    ids = set(row["effects"][0]["equivalent_to"])
    return any(
        named & right or ids & {name.rsplit(".", 1)[1] for name in right}
        for right in right_sets(row)
    )


def is_confident_and_wrong(row: Row) -> bool:
    """Returns whether a wrong name was given without doubt."""
    if row.get("verdict") != "named" or not row["effects"]:
        return False
    first = row["effects"][0]
    return first["probability"] >= 0.9 and not is_first_right(row)


def rate(rows: Iterable[Row], is_hit: Callable[[Row], bool]) -> str:
    """Returns a rate with its 95 % interval (Clopper and Pearson)."""
    hits = [bool(is_hit(row)) for row in rows]
    n, k = len(hits), sum(hits)
    if not n:
        return "–"
    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{k}/{n} = {k / n:.1%} ({low:.1%} to {high:.1%})"


def print_summary(path: Path) -> None:
    """Prints all rates of a file of rows."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    failed = [row for row in rows if "error" in row]
    rows = [row for row in rows if "error" not in row]
    print(f"{len(rows)} cases, {len(failed)} failed: {Counter(r['error'][:80] for r in failed)}")
    nulls = [row for row in rows if row["condition"].startswith("null")]
    print("false alarms:", rate(nulls, lambda r: r["p_value"] <= RATE))
    print("BIC forward selection, false alarms:", rate(nulls, lambda r: r.get("bic") is not None))
    for kind in sorted({row["condition"] for row in nulls}):
        own = [row for row in nulls if row["condition"] == kind]
        print(f"  {kind}:", rate(own, lambda r: r["p_value"] <= RATE))
        print(f"  {kind}, not 'none':", rate(own, lambda r: r["verdict"] != "none"))
    one = [row for row in rows if row["condition"] == "one"]
    for low, high in ((4.0, 7.0), (7.0, 15.0), (15.0, 1e9)):
        own = [row for row in one if low <= row["d"] < high]
        print(f"one effect, d {low:g} to {high:g}: first right", rate(own, is_first_right))
        print("   or in its class", rate(own, is_class_right))
        print("   confident and wrong", rate(own, is_confident_and_wrong))
        print("   spurious others", rate(own, lambda r: len(r["effects"]) > _size(r)))
        print("   BIC forward selection: first right", rate(own, _is_bic_right))
    by_effect: dict[str, list[Row]] = defaultdict(list)
    for row in one:
        if row["d"] >= 7.0:
            by_effect[row["truth"][0].rsplit(".", 1)[1]].append(row)
    print("by effect, d ≥ 7:")
    for name, own in sorted(by_effect.items()):
        missed = [(r["rig"], r["verdict"], *found_names(r)) for r in own if not is_class_right(r)]
        print(f"  {name}: {rate(own, is_class_right)} {missed}")
    for kind in ("inseparable", "outside", "without", "two", "absorbed", "bad_data"):
        own = [row for row in rows if row["condition"] == kind]
        if own:
            print(f"{kind}: verdicts {dict(Counter(r['verdict'] for r in own))}")
            print("   confident wrong name", rate(own, is_confident_and_wrong))
            if kind == "two":
                print("   both", rate(own, lambda r: set(r["truth"]) <= set(found_names(r))))
                print(
                    "   at least one",
                    rate(own, lambda r: bool(set(r["truth"]) & set(found_names(r)))),
                )
                print("   spurious third", rate(own, lambda r: len(r["effects"]) > _size(r)))
            if kind == "inseparable":
                print("   class", rate(own, is_class_right))
            if kind == "bad_data":
                print("   problem reported", rate(own, lambda r: bool(r["problems"])))
    _print_gap(rows)
    _print_parameters([row for row in one if row["d"] >= 7.0])
    _print_calibration([row for row in rows if row["condition"] in ("one", "inseparable", "two")])
    seconds = [row["cpu"] for row in rows]
    print(f"CPU seconds: median {np.median(seconds):.1f}, greatest {max(seconds):.1f}")


def _is_bic_right(row: Row) -> bool:
    return any(row.get("bic") in right for right in right_sets(row))


def _size(row: Row) -> int:
    return max(len(right) for right in right_sets(row))


def _print_gap(rows: list[Row]) -> None:
    closed = [
        row["gap"]["rmse"]["closed"]
        for row in rows
        if row["condition"] in ("one", "two")
        and row["d"] >= 7.0
        # A gap within the noise cannot be seen to close.
        and row["gap"]["rmse"]["before"] > 1.2 * row["gap"]["rmse"]["noise_floor"]
    ]
    if closed:
        low, middle = np.percentile(closed, [10, 50])
        print(
            f"held-out gap closed ({len(closed)}): median {middle:.1%}, 10th percentile {low:.1%}"
        )
    nulls = [row for row in rows if row["condition"].startswith("null")]
    worse = [r["gap"]["rmse"]["after"] / r["gap"]["rmse"]["before"] for r in nulls]
    if worse:
        print(f"null: held-out error after / before at most {max(worse):.4f}")


def _print_parameters(rows: list[Row]) -> None:
    """Prints errors and coverage of the effects' strengths where the first is right."""
    inside, errors = [], []
    for row in rows:
        for effect in row["effects"]:
            name = f"{effect['port']}.{effect['effect']}"
            for short, estimate in effect["parameters"].items():
                true = row["true_parameters"].get(f"{name}.{short}")
                if true is None or not math.isfinite(true):
                    continue
                low, high = estimate["hdi_94"]
                middle, half = 0.5 * (low + high), 0.5 * (high - low)
                half *= 1.645 / 1.881  # the 90 % interval
                inside.append(abs(true - middle) <= half)
                if true:
                    errors.append(abs(estimate["mean"] / true - 1.0))
    if inside:
        print(
            f"parameters ({len(inside)}): 90 % intervals cover {np.mean(inside):.1%}, "
            f"median error {np.median(errors):.1%}"
        )


def _print_calibration(rows: list[Row]) -> None:
    """Prints the expected calibration error of the first effect's probability."""
    pairs = [
        (row["effects"][0]["probability"], is_first_right(row)) for row in rows if row["effects"]
    ]
    if not pairs:
        return
    probability, right = map(np.array, zip(*pairs, strict=True))
    edges = np.array([0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0 + 1e-9])
    error = 0.0
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        own = (probability >= low) & (probability < high)
        if own.any():
            gap = abs(probability[own].mean() - right[own].mean())
            error += own.mean() * gap
            print(
                f"   probability {low:.2f} to {min(high, 1.0):.2f}: {own.sum()} cases, mean "
                f"{probability[own].mean():.2f}, right {right[own].mean():.2f}"
            )
    print(f"expected calibration error {error:.3f}")
