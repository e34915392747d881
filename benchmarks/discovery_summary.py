"""Summarises the rows of the blind benchmark as the lines of one table.

A rate comes with its 95 % interval after Clopper and Pearson, a percentile with one by the
bootstrap. "yes" and "no" say whether the figure itself meets its target; where the interval holds
the target, so few cases cannot tell, and the table says "open" beside it.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from discovery_figures import calibration_error, calibration_error_by_chance, reliability
from discovery_rows import (
    SEVERAL,
    Row,
    effect_id,
    estimates,
    has_all,
    has_all_classes,
    has_any,
    has_too_many,
    has_wrong,
    is_bic_right,
    is_class_right,
    is_confident_and_wrong,
    is_first_right,
    is_sparse_effect,
    is_sparse_right,
    is_sparse_unknown,
    sparse_name,
)
from discovery_table import Baselines, Line, Rate, bootstrap
from scipy.optimize import brentq
from scipy.special import erf

__all__ = ["STRONG", "by_effect", "expected_error", "gap_closed", "summary_lines"]

FALSE_ALARM_RATE = 0.01
"""The rate of false alarms that was asked for."""

WEAK, STRONG = 7.5, 9.9
"""Separations up to which an effect counts as one of d = 5, and from which as d ≥ 10."""

NULLS = {
    "null": "plain noise",
    "null_noise3": "three times the noise",
    "null_coloured": "coloured noise",
    "null_outliers": "outliers",
}
"""The conditions in which nothing is missing."""

NO_BASELINES = Baselines()

VISIBLE_GAP = 1.05
"""Held-out error in that of the true model from which a gap can be seen to close."""


def summary_lines(rows: Sequence[Row]) -> list[Line]:
    """Returns the lines of the table.

    Args:
        rows: Rows that were judged.
    """
    of = defaultdict(list)
    for row in rows:
        of[row["condition"]].append(row)
    nulls = [row for row in rows if row["condition"].startswith("null")]
    missing = of["outside"] + of["without"] + of["beyond"]
    return [
        *_null_lines(nulls),
        *_one_lines(of["one"]),
        _rate("inseparable: class reported", of["inseparable"], is_class_right, lower=0.95),
        _wrong("inseparable: confident wrong name", of["inseparable"], upper=0.02),
        *_pair_lines("two effects", of["two"], both=0.80, third=0.05),
        *_pair_lines("two at one place", of["two_at_one_place"], both=0.90, third=0.03),
        _rate("three effects: all", of["three"], has_all, lower=0.70),
        _rate("three effects: all, or in their classes", of["three"], has_all_classes),
        _rate("three effects: at least one", of["three"], has_any, baselines=_naming(of["three"])),
        _rate("three effects: a wrong one", of["three"], has_wrong, upper=0.05),
        *(
            _rate(
                f"{where}: “unknown”",
                own,
                lambda row: row["verdict"] == "unknown",
                lower=0.85,
                baselines=Baselines(sparse=_baseline(own, is_sparse_unknown, "sparse")),
            )
            for where, own in (
                ("not in the catalogue", missing),
                ("… no catalogue has it", of["outside"]),
                ("… its entry removed", of["without"]),
                ("… its entry removed, d beyond all others", of["beyond"]),
            )
        ),
        *(
            _wrong(f"{where}: confident impostor", own, upper=0.05)
            for where, own in (
                ("not in the catalogue", missing),
                ("… its entry removed, d beyond all others", of["beyond"]),
            )
        ),
        _rate("spoilt data: problem reported", of["bad_data"], lambda row: bool(row["problems"])),
        *_gap_lines(rows),
        *_parameter_lines([row for row in of["one"] if row["d"] >= STRONG]),
        *_calibration_lines(rows),
        *_time_lines(rows),
    ]


def _null_lines(nulls: list[Row]) -> list[Line]:
    def is_alarm(row: Row) -> bool:
        return row["p_value"] <= FALSE_ALARM_RATE

    lines = []
    kinds = sorted({row["condition"] for row in nulls})
    for kind in ("", *kinds):
        own = [row for row in nulls if not kind or row["condition"] == kind]
        label = f"… {NULLS.get(kind, kind)}" if kind else "nothing missing"
        lines.append(
            _rate(
                f"{label}: false alarms",
                own,
                is_alarm,
                upper=0.05,
                greatest_end=math.inf if kind else 0.08,
                baselines=Baselines(
                    _nothing(own),
                    _baseline(own, lambda row: row["bic"] is not None, "bic"),
                    _baseline(own, lambda row: sparse_name(row) is not None, "sparse"),
                ),
            )
        )
    worse = [row for row in nulls if row.get("gap")]
    lines.append(
        _rate("nothing missing: a name given", nulls, lambda row: row["verdict"] == "named"),
    )
    lines.append(
        Line(
            "nothing missing: greatest growth of the held-out error",
            len(worse),
            max((_ratio(row, "after", "before") - 1.0 for row in worse), default=math.nan),
            upper=0.01,
            baselines=Baselines(refit=_nothing(worse)),
        )
    )
    return lines


def _one_lines(one: list[Row]) -> list[Line]:
    strong = [row for row in one if row["d"] >= STRONG]
    weak = [row for row in one if row["d"] <= WEAK]
    lines = [
        _rate(
            "one effect, d ≥ 10: name or class first",
            strong,
            is_class_right,
            lower=0.98,
            baselines=_naming(strong),
        ),
        _rate("… the name itself", strong, is_first_right, baselines=_naming(strong)),
    ]
    effects = by_effect(strong)
    if effects:
        worst = min(effects, key=lambda name: Rate.of(effects[name], is_class_right).value)
        own = effects[worst]
        lines.append(
            _rate(
                f"… worst effect ({worst})",
                own,
                is_class_right,
                lower=0.90,
                baselines=_naming(own),
            )
        )
    return [
        *lines,
        _rate(
            "one effect, d = 5: name or class first",
            weak,
            is_class_right,
            lower=0.85,
            baselines=_naming(weak),
        ),
        _rate("… the name itself", weak, is_first_right, baselines=_naming(weak)),
        _wrong("one effect: confident wrong name", one),
        _rate("one effect: others beside it", one, has_too_many),
    ]


def _gap_lines(rows: Sequence[Row]) -> list[Line]:
    closed = gap_closed(rows)
    lines = []
    for label, percentile, aim in (("median", 50.0, 0.90), ("10th percentile", 10.0, 0.75)):
        value = float(np.percentile(closed, percentile)) if closed else math.nan
        lines.append(
            Line(
                f"held-out gap closed, d ≥ 10: {label}",
                len(closed),
                value,
                bootstrap(closed, percentile),
                lower=aim,
                baselines=Baselines(refit="0 %" if closed else "–"),
            )
        )
    own = [row for row in rows if _has_visible_gap(row)]
    after = [row["gap"]["rmse"]["after"] / _true_error(row) for row in own]
    before = [row["gap"]["rmse"]["before"] / _true_error(row) for row in own]
    lines.append(
        Line(
            "held-out error in that of the true model, median",
            len(own),
            float(np.median(after)) if own else math.nan,
            bootstrap(after, 50.0),
            unit="",
            baselines=Baselines(refit=f"{np.median(before):.3g}" if own else "–"),
        )
    )
    return lines


def gap_closed(rows: Iterable[Row]) -> list[float]:
    """Returns the shares of the held-out gaps that were closed, of gaps that can be seen.

    A gap is what the given model's error is above that of the true model, with the true effects
    and parameters: the rest of the latter is due to the errors of measurements and initial states.
    """
    return [
        (row["gap"]["rmse"]["before"] - row["gap"]["rmse"]["after"])
        / (row["gap"]["rmse"]["before"] - _true_error(row))
        for row in rows
        if _has_visible_gap(row)
    ]


def _has_visible_gap(row: Row) -> bool:
    if row["condition"] not in ("one", *SEVERAL) or not row["d"] >= STRONG or not row.get("gap"):
        return False
    if row.get("true_model") is None:
        return False
    return row["gap"]["rmse"]["before"] > VISIBLE_GAP * _true_error(row)


def _true_error(row: Row) -> float:
    return row["true_model"]["rmse"]


def _ratio(row: Row, one: str, other: str) -> float:
    return row["gap"]["rmse"][one] / row["gap"]["rmse"][other]


def _pair_lines(where: str, rows: Sequence[Row], *, both: float, third: float) -> list[Line]:
    return [
        _rate(f"{where}: both", rows, has_all, lower=both),
        _rate(f"{where}: both, or in their classes", rows, has_all_classes),
        _rate(f"{where}: at least one", rows, has_any, lower=0.98, baselines=_naming(rows)),
        _rate(f"{where}: spurious third", rows, has_too_many, upper=third),
    ]


def _parameter_lines(rows: Sequence[Row]) -> list[Line]:
    rigs = sorted({row["rig"] for row in rows})
    lines = _parameter_lines_of(rows, "parameters, d ≥ 10")
    for rig in rigs if len(rigs) > 1 else ():
        lines += _parameter_lines_of([row for row in rows if row["rig"] == rig], f"… {rig}")
    return lines


def _parameter_lines_of(rows: Sequence[Row], label: str) -> list[Line]:
    found = [judged for row in rows for judged in estimates(row)]
    inside = Rate(sum(judged.is_inside for judged in found), len(found))
    measured = [judged for judged in found if math.isfinite(judged.error)]
    errors = [judged.error for judged in measured]
    return [
        Line(
            f"{label}: 90 % intervals cover",
            inside.total,
            inside.value,
            inside.interval if inside.total else None,
            lower=0.85,
            upper=0.95,
        ),
        Line(
            f"{label}: median relative error",
            len(errors),
            float(np.median(errors)) if errors else math.nan,
            bootstrap(errors, 50.0),
            upper=0.08,
        ),
        Line(
            f"{label}: median relative error expected from the posteriors",
            len(errors),
            expected_error([judged.deviation for judged in measured]),
        ),
    ]


def expected_error(deviations: Sequence[float]) -> float:
    """Returns the median error of estimates with these standard deviations, if they are right.

    If the posteriors are exact, no estimator has a smaller median error. Recording and prior then
    leave more uncertainty than the target allows, if this is larger than the target.

    Args:
        deviations: Relative standard deviations of normal posteriors; NaN is left out.
    """
    known = np.array([d for d in deviations if math.isfinite(d) and d > 0.0])
    if not len(known):
        return math.nan

    def excess(error: float) -> float:
        return float(erf(error / known / math.sqrt(2.0)).mean()) - 0.5

    return float(brentq(excess, 0.0, 10.0 * float(known.max())))


def _calibration_lines(rows: Sequence[Row]) -> list[Line]:
    bins = reliability(rows)
    total = sum(part.right.total for part in bins)
    value = calibration_error(bins) if bins else math.nan
    chance = calibration_error_by_chance(bins) if bins else math.nan
    return [
        Line("expected calibration error", total, value, upper=0.05, unit=""),
        Line("… of perfect probabilities, 95 % of the time at most", total, chance, unit=""),
    ]


def _time_lines(rows: Sequence[Row]) -> list[Line]:
    screening = [
        sum(row["seconds"].get(stage, 0.0) for stage in ("fit", "check data", "screen"))
        for row in rows
        if "seconds" in row
    ]
    whole = [row["cpu"] for row in rows]
    return [
        Line(label, len(values), max(values, default=math.nan), upper=limit, unit=" s")
        for label, values, limit in (
            ("greatest time of screening, on the clock", screening, 20.0),
            ("greatest time of everything, processor, case made and all", whole, 300.0),
        )
    ] + [
        Line(
            "median time of everything",
            len(whole),
            float(np.median(whole)) if whole else math.nan,
            unit=" s",
        )
    ]


def by_effect(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Returns the rows of each hidden effect."""
    result: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        result[effect_id(row["truth"][0])].append(row)
    return result


def _rate(
    condition: str,
    rows: Sequence[Row],
    is_hit: Callable[[Row], bool],
    *,
    lower: float = -math.inf,
    upper: float = math.inf,
    greatest_end: float = math.inf,
    baselines: Baselines = NO_BASELINES,
) -> Line:
    share = Rate.of(rows, is_hit)
    return Line(
        condition,
        share.total,
        share.value,
        share.interval if share.total else None,
        lower=lower,
        upper=upper,
        greatest_end=greatest_end,
        baselines=baselines,
    )


def _wrong(condition: str, rows: Sequence[Row], *, upper: float = math.inf) -> Line:
    """Returns a line of confident wrong names; the baselines know no doubt."""
    return _rate(
        condition,
        rows,
        is_confident_and_wrong,
        upper=upper,
        baselines=Baselines(
            _nothing(rows),
            _baseline(rows, lambda r: r["bic"] is not None and not is_bic_right(r), "bic"),
            _baseline(rows, lambda r: is_sparse_effect(r) and not is_sparse_right(r), "sparse"),
        ),
    )


def _naming(rows: Sequence[Row]) -> Baselines:
    """Returns how often each baseline names what is right; refitting names nothing."""
    return Baselines(
        _nothing(rows),
        _baseline(rows, is_bic_right, "bic"),
        _baseline(rows, is_sparse_right, "sparse"),
    )


def _nothing(rows: Sequence[Row]) -> str:
    return "0 %" if rows else "–"


def _baseline(rows: Iterable[Row], is_hit: Callable[[Row], bool], name: str) -> str:
    """Returns a baseline's rate over the rows that have it."""
    own = [row for row in rows if name in row]
    if name == "sparse":
        if own and all(row["sparse"]["left_out"] == "not installed" for row in own):
            return "not installed"
        own = [row for row in own if not row["sparse"]["left_out"]]
    share = Rate.of(own, is_hit)
    return f"{100.0 * share.value:.3g} % of {share.total}" if share.total else "–"
