"""The report on a search for the missing effect, from the content of ``discovery.json``.

Everything except ``verdict`` is optional: a search that found no gap has no effects to report.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
)
from npdr_ppl.display.reports.effect_parts import effects_section, estimates_section
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
from npdr_ppl.drawing.effect_names import effect_label, in_words
from npdr_ppl.drawing.numbers import number
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import DiscoveryRecord

__all__ = ["discovery_report", "discovery_verdict"]

MOST_NAMED = 3
"""Maximum number of effects that the headline names; of more, only the number is given."""


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
        *recording_section(overlays),
        where_section(overlays, result.get("where") or []),
        Section("Gap on held-out rollouts", _gap(gap)),
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
    word = str(result.get("verdict", "no verdict"))
    effects = result.get("effects") or []
    large = [
        effect
        for effect in effects
        if not effect.get("is_minor") and all((effect.get("in_halves") or {}).values())
    ] or effects
    labels = [effect_label(effect) for effect in large]
    p_value = number((result.get("alarm") or {}).get("p_value"))
    gained = _gained(result.get("gap") or {})
    reason = in_words(str(result.get("reason") or ""))
    verdicts = {
        "none": Headline(
            "No effect is missing",
            f"The present model explains the recording (alarm: p = {p_value}).",
            "good",
        ),
        "named": Headline(f"Missing: {_listed(labels) or 'an effect'}", gained, "good"),
        "ambiguous": Headline(
            f"Missing: {labels[0] if labels else 'an effect'}, or another cause",
            f"The recording does not show which. {gained}",
            "warn",
        ),
        "unknown": Headline(
            "Something unknown is missing",
            _shortened(reason, effects) or "No effect of the catalogue explains the recording.",
            "bad",
        ),
    }
    return verdicts.get(word, Headline(word, reason))


def _shortened(reason: str, effects: list[Any]) -> str:
    """Returns a reason; without the list of effects if there are many, for the table has them."""
    if len(effects) <= MOST_NAMED:
        return reason
    start = "The best explanation so far is "
    head, found, rest = reason.partition(start)
    if not found:
        return reason
    tail = rest.split("; ", 1)[-1] if "; " in rest else ""
    return f"{head}The best explanation so far has {len(effects)} effects; {tail}"


def _listed(labels: list[str]) -> str:
    if len(labels) > MOST_NAMED:
        return f"{labels[0]}, and {len(labels) - 1} more effects"
    return (
        ", and ".join((", ".join(labels[:-1]), labels[-1])) if len(labels) > 1 else "".join(labels)
    )


def _gained(gap: Mapping[str, Any]) -> str:
    """Returns a sentence about the gain of the revised model on held-out rollouts."""
    closed = [
        f"{min(values['closed'], 1.0):.0%} in {METRICS.get(metric, metric)}"
        for metric, values in gap.items()
        if values.get("closed") is not None
    ]
    if not closed:
        return "The gain on held-out rollouts was not measured."
    return f"Of the gap on held-out rollouts it closes {', '.join(closed)}."


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


def _gap(gap: Mapping[str, Any]) -> list[Part]:
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
    return [TablePart(("metric", "before", "after", "noise floor", "closed"), rows, caption)]


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
