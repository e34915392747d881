"""The report on a comparison of backends."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.charts import bars_chart, intervals_chart, lines_chart
from npdr_ppl.display.reports.content import (
    Explained,
    FindingsPart,
    Headline,
    KeyFigure,
    Part,
    Report,
    Section,
    TablePart,
)
from npdr_ppl.display.reports.provenance import provenance_section, run_description, source_section
from npdr_ppl.drawing.numbers import number
from npdr_ppl.posterior.comparison.compared_backends import folder_name
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import ComparisonRecord

__all__ = ["comparison_report"]

MAX_FORESTS = 12
"""Maximum number of parameters whose intervals are drawn."""


def comparison_report(folder: Path) -> Report:
    """Reads the results of ``npdr compare``.

    Args:
        folder: Folder with ``comparison.json``.
    """
    result = read_json(folder / "comparison.json", ComparisonRecord)
    rows, ranking = result["backends"], result["ranking"]
    settings = result.get("settings") or {}
    # All backends ran on the same data and model, so the description of the best one is used.
    own = folder / folder_name(ranking[0]) if ranking else folder
    description = run_description(own)
    ranked = {label: rows[label] for label in ranking}
    return Report(
        "compare",
        f"Comparison of {len(rows)} backends",
        _verdict(ranked),
        _key_figures(result, settings),
        [
            Section("Ranking", _ranking(ranked, result.get("weights") or {})),
            Section("Calibration of predictions", [_coverage_chart(ranked)]),
            Section("Parameters", _forests(ranked)),
            Section("Cost", [_seconds_chart(ranked)]),
            Section("Diagnoses", [FindingsPart(_diagnoses(rows))]),
            *source_section(description),
            provenance_section(description | {"rounds": settings.get("rounds")}, own),
        ],
    )


def _verdict(ranked: Mapping[str, Any]) -> Headline:
    if not ranked:
        return Headline("nothing to rank", "Every backend failed.", "bad")
    best, *others = ranked
    if not others:
        return Headline(best, "It was the only one that finished.", "plain")
    second = ranked[others[0]]
    behind, error = second.get("elpd_difference"), second.get("elpd_difference_se")
    if behind is None:
        return Headline(best, f"Best by CRPS; {others[0]} is second. No elpd was finite.", "plain")
    shown = f"{others[0]} has {number(abs(behind), '.1f')} ± {number(error, '.1f')} less elpd"
    if error is None:
        return Headline(
            best, f"{others[0]} has an elpd difference of {behind:.1f} on one segment.", "warn"
        )
    if abs(behind) > 2 * error:
        word, tone = ranked[best].get("decision"), "good"
        sentence = f"It predicts best; {shown}."
        if word != "accept":
            sentence, tone = f"{sentence} Its own diagnosis says: {word}.", "warn"
        return Headline(best, sentence, tone)
    return Headline(
        f"{best}, by a small margin", f"{shown}, which may be chance: use the cheaper one.", "warn"
    )


def _key_figures(result: Mapping[str, Any], settings: Mapping[str, Any]) -> list[KeyFigure]:
    rows, ranking = result["backends"], result["ranking"]
    best = rows[ranking[0]] if ranking else {}
    budget = (settings.get("rounds") or 0) * (settings.get("num_simulations") or 0)
    return [
        KeyFigure(
            "elpd of the best", number(best.get("elpd"), ".1f"), str(settings.get("elpd", ""))
        ),
        KeyFigure("RMSE of the best", number(best.get("rmse")), "most likely draw"),
        KeyFigure("Simulations each", str(budget) if budget else "–"),
        KeyFigure("Judged by", str(settings.get("evaluated_on", "–")), "data"),
        KeyFigure("Failed", str(sum(row.get("error") is not None for row in rows.values()))),
    ]


def _ranking(ranked: Mapping[str, Any], weights: Mapping[str, Any]) -> list[Part]:
    columns = ("backend", "elpd", "behind", "weight", "RMSE", "DTW", "CRPS", "r̂", "decision")
    rows = [
        [
            label,
            number(row.get("elpd"), ".1f"),
            f"{number(row.get('elpd_difference'), '.1f')} ± "
            f"{number(row.get('elpd_difference_se'), '.1f')}",
            number(row.get("weight"), ".2f"),
            number(row.get("rmse")),
            number(row.get("dtw"), ".0f"),
            number(row.get("crps")),
            number(row.get("r_hat"), ".2f"),
            str(row.get("decision", "–")),
        ]
        for label, row in ranked.items()
    ]
    caption = (
        "Best first. elpd: log predictive density of the segments, larger is better. Weight: its "
        "share in the mixture that predicts best. CRPS: error of a predictive distribution."
    )
    parts: list[Part] = [TablePart(columns, rows, caption)]
    behind = {
        label: (float(d) - 2 * (e or 0.0), float(d), float(d) + 2 * (e or 0.0))
        for label, row in ranked.items()
        if (d := row.get("elpd_difference")) is not None
        for e in (row.get("elpd_difference_se"),)
    }
    if behind:
        caption = "Difference from the best, ± two standard errors; across 0 it may be chance."
        parts.append(
            intervals_chart("behind", behind, title="difference in elpd", caption=caption)
        )
    if weights:
        parts.append(
            bars_chart(
                "weights",
                {"weight": dict(weights)},
                title="stacking weight",
                caption="Mixture of posteriors that predicts the segments best.",
            )
        )
    return parts


def _coverage_chart(ranked: Mapping[str, Any]) -> Part:
    lines = {
        label: ([float(level) / 100 for level in row["coverage"]], list(row["coverage"].values()))
        for label, row in ranked.items()
        if row.get("coverage")
    }
    caption = (
        "Share of measurements inside the central predictive interval. Below the dotted line, "
        "predictive intervals are too narrow; above it, they are too wide."
    )
    titles = ("probability of the interval", "share of measurements inside")
    return lines_chart("coverage", lines, titles=titles, caption=caption, diagonal=True)


def _forests(ranked: Mapping[str, Any]) -> list[Part]:
    names = list(dict.fromkeys(n for row in ranked.values() for n in row.get("parameters") or {}))
    parts: list[Part] = []
    for index, name in enumerate(names[:MAX_FORESTS]):
        rows = {
            label: (p["hdi_94"][0], p["mean"], p["hdi_94"][1])
            for label, row in ranked.items()
            if (p := (row.get("parameters") or {}).get(name)) and not isinstance(p["mean"], list)
        }
        if rows:
            caption = f"{name}: mean and 94 % interval by backend."
            parts.append(intervals_chart(f"forest-{index}", rows, title=name, caption=caption))
    return parts


def _seconds_chart(ranked: Mapping[str, Any]) -> Part:
    kinds = list(dict.fromkeys(k for row in ranked.values() for k in row.get("seconds") or {}))
    bars = {
        kind: {label: (row["seconds"] or {}).get(kind) or 0.0 for label, row in ranked.items()}
        for kind in kinds
    }
    return bars_chart("seconds", bars, title="seconds", caption="Computing time by stage.")


def _diagnoses(rows: Mapping[str, Any]) -> list[Explained]:
    result = []
    for label, row in rows.items():
        if row.get("error") is not None:
            result.append(Explained(label, "failed", "bad", str(row["error"])))
            continue
        diagnosis = row.get("diagnosis") or {}
        word = str(row.get("decision", "–"))
        tone = "good" if word == "accept" else "warn"
        result.append(Explained(label, word, tone, str(diagnosis.get("reason", ""))))
    return result
