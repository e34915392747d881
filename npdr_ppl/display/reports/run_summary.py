"""What several runs have in common: parameters with intervals, effects, gaps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.discovery_report import discovery_verdict
from npdr_ppl.display.reports.meanings import decision_verdict
from npdr_ppl.display.reports.provenance import run_description
from npdr_ppl.errors import DataError
from npdr_ppl.run_files import read_json, reading_back
from npdr_ppl.run_records import DiscoveryRecord, FitRecord, TrainingRecord

__all__ = ["Estimate", "RunSummary", "summaries", "summary"]


@dataclass(frozen=True)
class Estimate:
    """A parameter's posterior in one run.

    Attributes:
        mean: Its mean, in the parameter's unit.
        sd: Its standard deviation.
        low: Lower end of the 94 % interval.
        high: Upper end.
        unit: The unit; empty if not known.
    """

    mean: float
    sd: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class RunSummary:
    """A run in a few numbers.

    Attributes:
        label: Name of the run on the page.
        kind: Command that made it.
        model: Name of the model; empty if not known.
        verdict: Its main result in a few words.
        parameters: Scalar parameters by name.
        effects: Entries of ``effects`` in ``discovery.json``; ``None`` if nothing was searched.
        gap: Metrics before and after, as in ``discovery.json``.
        laws: Formulas of learned laws, by port and effect as in ``"hinge.learned_hinge"``.
        data: Checksums of the recordings; empty if not known.
        seed: Seed as text.
    """

    label: str
    kind: str
    model: str
    verdict: str
    parameters: dict[str, Estimate]
    effects: Sequence[Mapping[str, Any]] | None = None
    gap: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    laws: Mapping[str, str] = field(default_factory=dict)
    data: tuple[str, ...] = ()
    seed: str = "–"


def summaries(folders: Sequence[Path]) -> list[RunSummary]:
    """Reads several runs.

    Raises:
        DataError: A folder is given twice, or is not that of a fit, a search or a training.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise DataError("A run is given twice; give different folders.")
    labels = _labels(folders)
    return [summary(folder, label) for folder, label in zip(folders, labels, strict=True)]


def summary(folder: Path, label: str) -> RunSummary:
    """Reads one run.

    Args:
        folder: Folder of the run.
        label: Its name on the page.
    """
    readers = {"discovery.json": _discovery, "train.json": _training, "fit.json": _fit}
    for name, reader in readers.items():
        if (folder / name).exists():
            with reading_back(folder / name):
                return reader(folder, label)
    raise DataError(
        f"{folder} holds none of {', '.join(readers)}; give runs of npdr fit, discover or train."
    )


def _discovery(folder: Path, label: str) -> RunSummary:
    result = read_json(folder / "discovery.json", DiscoveryRecord)
    learned = result.get("learned") or {}
    laws = (learned.get("laws") or []) if learned.get("offered") else []
    # A law is another effect if it has another formula, although its id is that of the port.
    found = [{"effect": f"learned law {law['formula']}", "port": law["port"]} for law in laws]
    return RunSummary(
        label,
        "discover",
        verdict=discovery_verdict(result).word,
        parameters=_estimates(result.get("parameters") or {}, {}),
        effects=[*(result.get("effects") or []), *found],
        gap=result.get("gap") or {},
        laws={f"{law['port']}.{law['effect']}": law["formula"] for law in laws},
        **_origin(folder),
    )


def _fit(folder: Path, label: str) -> RunSummary:
    result = read_json(folder / "fit.json", FitRecord)
    metrics = result.get("metrics") or {}
    return RunSummary(
        label,
        "fit",
        verdict=decision_verdict(result.get("diagnosis") or {}).word,
        parameters=_estimates(result["parameters"], result.get("units") or {}),
        gap={name: {"after": metrics.get(name)} for name in ("rmse", "dtw") if name in metrics},
        **_origin(folder),
    )


def _training(folder: Path, label: str) -> RunSummary:
    result = read_json(folder / "train.json", TrainingRecord)
    last = result["iterations"][-1] if result["iterations"] else None
    return RunSummary(
        label,
        "train",
        verdict=f"{len(result['iterations'])} iterations",
        parameters=_estimates(last["parameters"] if last else {}, {}),
        **_origin(folder),
    )


def _origin(folder: Path) -> dict[str, Any]:
    description = run_description(folder)
    model = description.get("model")
    name = model.get("name", "") if isinstance(model, Mapping) else ""
    data = description.get("recordings") or [description.get("fingerprint")]
    return {
        "model": str(name or ""),
        "data": tuple(str(value) for value in data if value),
        "seed": str(description.get("seed", "–")),
    }


def _estimates(rows: Mapping[str, Any], units: Mapping[str, str]) -> dict[str, Estimate]:
    """Returns the scalar parameters whose posterior is known."""
    found = {}
    for name, row in rows.items():
        values = [row.get("mean"), row.get("sd"), *(row.get("hdi_94") or [None, None])]
        if len(values) == 4 and all(map(_is_number, values)):
            found[name] = Estimate(*values, unit=str(row.get("unit") or units.get(name, "")))
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _labels(folders: Sequence[Path]) -> list[str]:
    """Returns the shortest ends of the paths that differ."""
    parts = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts)) + 1):
        labels = ["/".join(p[-length:]) for p in parts]
        if len(set(labels)) == len(labels):
            return labels
    return [str(folder) for folder in folders]
