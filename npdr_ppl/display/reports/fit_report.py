"""The report on a fit."""

from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.charts import intervals_chart
from npdr_ppl.display.reports.content import (
    FindingsPart,
    KeyFigure,
    Part,
    Report,
    Section,
    TablePart,
    TextPart,
)
from npdr_ppl.display.reports.meanings import decision_verdict, findings
from npdr_ppl.display.reports.posterior_parts import posterior_charts, predictive_charts
from npdr_ppl.display.reports.provenance import provenance_section, run_description, source_section
from npdr_ppl.drawing.numbers import interval, number, uncertain
from npdr_ppl.hdf5_checks import check_self_contained, named_netcdf
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import FitRecord

__all__ = ["fit_report", "parameters_table"]

MAX_ROWS = 1_000
"""Largest number of parameters in a table or chart, so that a page can be read and opens fast."""


def fit_report(folder: Path) -> Report:
    """Reads the results of ``npdr fit``.

    Args:
        folder: Folder with ``fit.json`` and ``posterior.nc``.
    """
    result = read_json(folder / "fit.json", FitRecord)
    description = run_description(folder)
    diagnosis = result.get("diagnosis") or {}
    data = _posterior(folder)
    return Report(
        "fit",
        f"Fit of {len(result['parameters'])} parameters by {result['backend']}",
        decision_verdict(diagnosis),
        _key_figures(result, diagnosis),
        [
            *_recording(folder, data),
            Section("Parameters", _parameters(result, diagnosis, data)),
            Section("Diagnostics", [FindingsPart(findings(diagnosis))]),
            *source_section(description),
            provenance_section(description, folder),
        ],
    )


def parameters_table(
    parameters: Mapping[str, Any],
    *,
    units: Mapping[str, str],
    most_likely: Mapping[str, Any],
    contraction: Mapping[str, Any],
) -> TablePart:
    """Returns mean, spread and interval of the first parameters as a table."""
    elements = (
        (units.get(name, ""), element)
        for name, row in parameters.items()
        for element in _elements(name, row, most_likely.get(name))
    )
    rows = [
        [
            f"{label} [{unit}]" if unit and unit != "1" else label,
            uncertain(mean, sd),
            number(sd, ".2g"),
            interval(bounds),
            uncertain(likely, sd),
            number(contraction.get(label), ".0%"),
        ]
        for unit, (label, mean, sd, bounds, likely) in islice(elements, MAX_ROWS)
    ]
    columns = ("parameter", "mean", "sd", "94 % interval", "most likely", "contraction")
    caption = "The interval contains 94 % of the posterior."
    if next(elements, None) is not None:
        caption += f" Only the first {MAX_ROWS} parameters are shown."
    return TablePart(columns, rows, caption)


def _elements(
    name: str, row: Mapping[str, Any], likely: Any
) -> list[tuple[str, Any, Any, Any, Any]]:
    """Returns label, mean, sd, interval and most likely value of every scalar of a parameter."""
    mean, sd, interval = row["mean"], row["sd"], row["hdi_94"]
    if not isinstance(mean, list):
        return [(name, mean, sd, interval, likely)]
    likely = likely if isinstance(likely, list) else [None] * len(mean)
    result: list[tuple[str, Any, Any, Any, Any]] = []
    for i, parts in enumerate(zip(mean, sd, interval, likely, strict=True)):
        label = name[:-1] + f",{i}]" if name.endswith("]") else f"{name}[{i}]"
        result += _elements(
            label, dict(zip(("mean", "sd", "hdi_94"), parts, strict=False)), parts[3]
        )
    return result


def _key_figures(result: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> list[KeyFigure]:
    metrics, seconds = result.get("metrics") or {}, result.get("seconds") or {}
    judged = f"on {metrics.get('evaluated_on', 'fitted')} rollouts"
    figures = [
        KeyFigure("RMSE", number(metrics.get("rmse")), judged),
        KeyFigure("DTW", number(metrics.get("dtw")), judged),
        KeyFigure("Coverage of the 90 % band", number(diagnosis.get("coverage_90"), ".0%")),
        KeyFigure("r̂ across members", number(diagnosis.get("r_hat"), ".2f")),
        KeyFigure(
            "Time",
            f"{sum(v for v in seconds.values() if v is not None):.0f} s",
            ", ".join(f"{name} {number(value, '.0f')} s" for name, value in seconds.items()),
        ),
    ]
    if faults := result.get("faults"):
        lost = ", ".join(f"{count} {name}" for name, count in faults.items())
        figures.append(KeyFigure("Faulty simulations", str(sum(faults.values())), lost))
    return figures


def _parameters(result: Mapping[str, Any], diagnosis: Mapping[str, Any], data: Any) -> list[Part]:
    contraction = diagnosis.get("contraction") or {}
    parts: list[Part] = [
        parameters_table(
            result["parameters"],
            units=result.get("units") or {},
            most_likely=result.get("most_likely") or {},
            contraction=contraction,
        )
    ]
    if data:
        return parts + posterior_charts(data, result.get("units") or {})
    # Without draws, only the intervals are drawn, relative to the means.
    scalars = {
        name: row
        for name, row in result["parameters"].items()
        if not isinstance(row["mean"], list) and row["mean"]
    }
    rows = {
        name: (row["hdi_94"][0] / row["mean"], 1.0, row["hdi_94"][1] / row["mean"])
        for name, row in islice(scalars.items(), MAX_ROWS)
    }
    caption = "94 % intervals relative to the mean; the draws (posterior.nc) are missing."
    if not rows:
        return [*parts, TextPart("The draws (posterior.nc) are missing.")]
    return [*parts, intervals_chart("intervals", rows, title="relative to mean", caption=caption)]


def _recording(folder: Path, data: Any) -> list[Section]:
    if not data:
        return []
    charts = predictive_charts(data, folder / "run")
    return [Section("Predictions and the recording", charts)] if charts else []


def _posterior(folder: Path) -> Any:
    """Returns the ArviZ object with the draws, or ``None`` if there is none."""
    file = folder / "posterior.nc"
    if not file.exists():
        return None
    # ArviZ takes a second to import, so it is imported only if there are draws that can be read.
    with named_netcdf(file):
        check_self_contained(file)
    from npdr_ppl.arviz_module import from_netcdf

    return from_netcdf(file)
