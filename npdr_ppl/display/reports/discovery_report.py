"""The report on a search for the missing effect, from the content of ``discovery.json``.

Everything except ``verdict`` is optional: a search that found no gap has no effects to report.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from npdr_ppl.discovery.headline import headline
from npdr_ppl.display.reports.content import (
    DrawingPart,
    FoldedPart,
    Headline,
    KeyFigure,
    Part,
    Report,
    Section,
    TablePart,
    TextPart,
    Tone,
)
from npdr_ppl.display.reports.effect_parts import effects_section, estimates_section
from npdr_ppl.display.reports.learned_parts import learned_section
from npdr_ppl.display.reports.next_steps import next_section
from npdr_ppl.display.reports.overlay_parts import (
    lead_curve,
    read_overlays,
    recording_section,
    where_section,
)
from npdr_ppl.display.reports.provenance import provenance_section, run_description, source_section
from npdr_ppl.display.reports.revision_parts import pictures_section, revision_section
from npdr_ppl.drawing.bars_html import METRICS, gap_bars
from npdr_ppl.drawing.numbers import number
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import DiscoveryRecord

__all__ = ["discovery_report", "discovery_verdict"]

TONES: Mapping[str, Tone] = {
    "none": "good",
    "named": "good",
    "ambiguous": "warn",
    "unknown": "bad",
    "learned": "good",
}


def discovery_report(folder: Path) -> Report:
    """Reads the results of ``npdr discover``.

    Args:
        folder: Folder with ``discovery.json``, and possibly ``overlays.json``,
            ``revised_model.py`` and figures.
    """
    result = read_json(folder / "discovery.json", DiscoveryRecord)
    description = run_description(folder) | {
        name: result.get(name) for name in ("model", "seed", "versions") if name in result
    }
    overlays = read_overlays(folder)
    gap = result.get("gap") or {}
    verdict = discovery_verdict(result)
    sections = [
        next_section(result, said=verdict.sentence),
        effects_section(result.get("effects") or [], result.get("ranking") or []),
        *learned_section(result.get("learned") or {}),
        *recording_section(overlays),
        where_section(overlays, result.get("where") or []),
        Section("Gap on held-out rollouts", _gap(gap, result.get("estimated_anew") or {})),
        *estimates_section(result.get("parameters") or {}),
        *_preparation(result),
        *revision_section(folder, description),
        *pictures_section(folder),
        *source_section(description),
        provenance_section(description, folder),
    ]
    curves = lead_curve(overlays)
    bars = gap_bars(gap)
    lead = [curves] if curves is not None else []
    if bars:
        lead.append(DrawingPart(bars, "Error on held-out rollouts, before and after."))
    model = description.get("model")
    name = model.get("name") if isinstance(model, Mapping) else None
    title = "Search for the missing effect" + (f": {name}" if name else "")
    return Report("discover", title, verdict, _key_figures(result), sections, lead)


def discovery_verdict(result: Mapping[str, Any]) -> Headline:
    """Returns the verdict of ``discovery.json`` in one sentence."""
    return Headline(*headline(result), TONES.get(str(result.get("verdict")), "plain"))


def _key_figures(result: Mapping[str, Any]) -> list[KeyFigure]:
    alarm, remainder = result.get("alarm") or {}, result.get("remainder") or {}
    fired = alarm.get("fired")
    word = "–" if fired is None else "something is missing" if fired else "nothing is missing"
    figures = [KeyFigure("Alarm, original model", word, f"p = {number(alarm.get('p_value'))}")]
    if remainder and result.get("effects"):
        left = number(remainder.get("unexplained"), ".0%")
        figures.append(
            KeyFigure(
                "Misfit left after the revision", left, f"p = {number(remainder['p_value'])}"
            )
        )
    for metric, values in (result.get("gap") or {}).items():
        if metric != "rmse":
            continue
        shown = f"{number(values.get('before'))} → {number(values.get('after'))}"
        note = "held-out rollouts, relative to each channel's range"
        figures.append(KeyFigure("RMSE", shown, note))
    seconds = sum(v for v in (result.get("seconds") or {}).values() if v is not None)
    if seconds:
        figures.append(KeyFigure("Time", f"{seconds:.0f} s"))
    return figures


def _gap(gap: Mapping[str, Any], anew: Mapping[str, Any]) -> list[Part]:
    if not gap:
        return [TextPart("No gap was measured: give held-out rollouts with --holdout.")]
    names = ("before", "after", "noise_floor")
    rows = [
        [
            METRICS.get(metric, metric),
            *(number(values.get(name)) for name in names),
            number(values.get("closed"), ".0%"),
        ]
        for metric, values in gap.items()
    ]
    caption = (
        "Closed: share of the distance from before to the noise floor, the error of the revised "
        "model on a recording that it simulated itself. By chance a model can be below the floor."
    )
    table = TablePart(("metric", "before", "after", "noise floor", "closed"), rows, caption)
    return [table, *_anew(anew)]


def _anew(anew: Mapping[str, Any]) -> list[Part]:
    """Returns the values of parameters that were estimated anew on held-out rollouts."""
    names = ("searched", "first half", "second half")
    rows = [
        [site.replace("_", " "), *(number(values.get(name), ".4g") for name in names)]
        for site, values in anew.items()
    ]
    caption = (
        "Parameters that can differ between recordings of one device, estimated anew on the "
        "held-out rollouts. Each half was predicted with the values of the other half."
    )
    return [TablePart(("parameter", *names), rows, caption)] if rows else []


def _preparation(result: Mapping[str, Any]) -> list[Section]:
    """Returns how the recording was read, its faults and what was done about them."""
    preparation = result.get("preparation") or {}
    problems = [str(text) for text in result.get("data_problems") or []]
    remarks = [str(text) for text in result.get("remarks") or []]
    sentence = str(preparation.get("sentence") or "")
    parts: list[Part] = [TextPart(text) for text in (sentence, *problems) if text]
    if remarks:
        parts.append(FoldedPart("How the recording was read", [TextPart(t) for t in remarks]))
    return [Section("Recording and preparation", parts)] if parts else []
