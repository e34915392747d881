"""The report on a search for the missing effect, from the content of ``discovery.json``.

Everything except ``verdict`` is optional: a search that found no gap has no effects to report.
"""

import base64
import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.charts import ChartPart, bars_chart, layout_of, rounded
from npdr_ppl.display.reports.content import (
    CodePart,
    DiffPart,
    Headline,
    KeyFigure,
    Part,
    PicturePart,
    Report,
    Section,
    TablePart,
    TextPart,
)
from npdr_ppl.display.reports.provenance import provenance_section, run_description, source_section
from npdr_ppl.drawing.numbers import number
from npdr_ppl.drawing.theme import SERIES
from npdr_ppl.run_files import read_bytes, read_json, read_text
from npdr_ppl.run_records import DiscoveryRecord

__all__ = ["discovery_report"]

MAX_PICTURE_BYTES = 700_000
"""Maximum total size of the pictures on a page in base64 characters, so that the page stays
small; larger ones are only named."""


MAX_COMPARED = 100_000
"""Maximum number of characters of two models that are compared; this takes up to a second."""


def discovery_report(folder: Path) -> Report:
    """Reads the results of ``npdr discover``.

    Args:
        folder: Folder with ``discovery.json``, and possibly ``revised_model.py`` and figures.
    """
    result = read_json(folder / "discovery.json", DiscoveryRecord)
    description = run_description(folder) | {
        name: result.get(name) for name in ("model", "seed", "versions") if name in result
    }
    effects = result.get("effects") or []
    sections = [
        Section("Gap on held-out rollouts", _gap(result.get("gap") or {})),
        Section("Effects", _effects(effects, result.get("ranking") or [])),
        Section("Where", _where(result.get("where") or [])),
        *_next(result.get("next_experiment")),
        *_revision(folder, description),
        *_pictures(folder),
        *source_section(description),
        provenance_section(description, folder),
    ]
    return Report(
        "discover",
        "Search for the missing effect",
        _verdict(result, effects),
        _key_figures(result, effects),
        sections,
    )


def _verdict(result: Mapping[str, Any], effects: list[Any]) -> Headline:
    word = str(result["verdict"])
    large = [
        effect
        for effect in effects
        if not effect.get("is_minor") and all((effect.get("in_halves") or {}).values())
    ] or effects
    best = _named(large[0]) if large else "an effect"
    others = ", ".join(_named(effect) for effect in large[1:])
    p_value = number((result.get("alarm") or {}).get("p_value"))
    gained = _gained(result.get("gap") or {})
    verdicts = {
        "none": Headline(
            "no effect is missing",
            f"The present model explains the recording (alarm: p = {p_value}).",
            "good",
        ),
        "named": Headline(f"missing: {best}", gained, "good"),
        "ambiguous": Headline(
            f"missing: {best}, or another",
            f"These data do not distinguish it from {others or 'its equivalents'}. {gained}",
            "warn",
        ),
        "unknown": Headline(
            "something unknown is missing",
            str(result.get("reason") or "No effect of the catalogue explains the recording."),
            "bad",
        ),
    }
    return verdicts.get(word, Headline(word, str(result.get("reason", ""))))


def _gained(gap: Mapping[str, Any]) -> str:
    """Returns a sentence about the gain of the revised model on held-out rollouts."""
    closed = [
        f"{values['closed']:.0%} in {metric}"
        for metric, values in gap.items()
        if values.get("closed") is not None
    ]
    if not closed:
        return "The gain on held-out rollouts was not measured."
    return f"Of the gap on held-out rollouts it closes {', '.join(closed)}."


def _key_figures(result: Mapping[str, Any], effects: list[Any]) -> list[KeyFigure]:
    alarm = result.get("alarm") or {}
    fired = alarm.get("fired")
    word = "–" if fired is None else "fired" if fired else "silent"
    figures = [KeyFigure("Alarm", word, f"p = {number(alarm.get('p_value'))}")]
    if effects:
        figures.append(
            KeyFigure(
                "Probability", number(effects[0].get("probability"), ".0%"), _named(effects[0])
            )
        )
    for metric, values in (result.get("gap") or {}).items():
        shown = f"{number(values.get('before'))} → {number(values.get('after'))}"
        figures.append(
            KeyFigure(f"Gap closed, {metric}", number(values.get("closed"), ".0%"), shown)
        )
    return figures


def _with_sd(value: Mapping[str, Any]) -> str:
    """Returns a mean with its standard deviation."""
    return f"{number(value.get('mean'), '.4g')} ± {number(value.get('sd'), '.2g')}"


def _gap(gap: Mapping[str, Any]) -> list[Part]:
    if not gap:
        return [TextPart("No gap was measured.")]
    names = ("before", "after", "noise_floor")
    rows = [
        [
            metric,
            *(number(values.get(name)) for name in names),
            number(values.get("closed"), ".0%"),
        ]
        for metric, values in gap.items()
    ]
    caption = (
        "Closed: share of the distance from before to the noise floor, the error of the revised "
        "model on a recording that it simulated itself."
    )
    columns = ("metric", "before", "after", "noise floor", "closed")
    parts: list[Part] = [TablePart(columns, rows, caption)]
    # Metrics have different scales, so each is drawn relative to its value before.
    data: list[dict[str, Any]] = []
    for name, color in zip(names, SERIES, strict=False):
        shares = {
            metric: values[name] / values["before"]
            for metric, values in gap.items()
            if values.get("before") and values.get(name) is not None
        }
        label = name.replace("_", " ")
        data.append(
            {
                "type": "bar",
                "name": label,
                "marker": {"color": color},
                "x": list(shares),
                "y": rounded(list(shares.values())),
            }
        )
    layout = layout_of("", "relative to before") | {"barmode": "group"}
    parts.append(ChartPart("gap", "Error on held-out rollouts, relative to before.", data, layout))
    return parts


def _effects(effects: list[Any], ranking: list[Any]) -> list[Part]:
    if not effects:
        return [TextPart("No effect was added.")]
    rows = [
        [
            _named(effect),
            number(effect.get("probability"), ".0%"),
            number(effect.get("share"), ".0%") + (" (small)" if effect.get("is_minor") else ""),
            ", ".join(map(str, effect.get("equivalent_to") or [])) or "–",
        ]
        for effect in effects
    ]
    columns = ("effect", "probability", "share of the misfit", "not distinguishable from")
    caption = "Small effects are in the revised model, but are not named."
    is_any_small = any(effect.get("is_minor") for effect in effects)
    parts: list[Part] = [TablePart(columns, rows, caption if is_any_small else "")]
    parameters = [
        [
            f"{_named(effect)}, {name}",
            number(row.get("mean"), ".4g"),
            number(row.get("sd"), ".2g"),
            " … ".join(number(bound, ".4g") for bound in row.get("hdi_94") or []) or "–",
            str(row.get("unit", "")),
        ]
        for effect in effects
        for name, row in (effect.get("parameters") or {}).items()
    ]
    parameters += [
        [f"{_named(effect)}, {name}", number(value, ".4g"), "–", "–", ""]
        for effect in effects
        for name, value in (effect.get("constants") or {}).items()
    ]
    if parameters:
        columns = ("parameter", "mean", "sd", "94 % interval", "unit")
        parts.append(TablePart(columns, parameters, "Parameters of the effects."))
    repeated = [
        [f"{_named(effect)}, {name}", str(part.get("part")), _with_sd(value)]
        for effect in effects
        for part in effect.get("parts") or []
        for name, value in (part.get("strengths") or {}).items()
    ]
    if repeated:
        caption = "Found again? Strengths in the two parts of the recording that differ most."
        parts.append(TablePart(("strength", "part", "mean ± sd"), repeated, caption))
    searched = [
        [_named(effect), *("yes" if is_in else "no" for is_in in halves.values())]
        for effect in effects
        if (halves := effect.get("in_halves") or {})
    ]
    if searched:
        names = next(e["in_halves"] for e in effects if e.get("in_halves"))
        caption = "Found by a search of only half of the recording?"
        parts.append(TablePart(("effect", *names), searched, caption))
    scored = {
        _named(e): float(e["probability"])
        for e in ranking or effects
        if isinstance(e, Mapping) and e.get("probability") is not None
    }
    if scored:
        caption = "Probability of each tested candidate."
        parts.append(
            bars_chart(
                "probability", {"probability": scored}, title="probability", caption=caption
            )
        )
    return parts


def _where(where: list[Any]) -> list[Part]:
    if not where:
        return [TextPart("No window deviates significantly.")]
    rows = [
        [
            str(place.get("channel", "–")),
            str(place.get("rollout", "–")),
            _span(place.get("time_span", place.get("time"))),
            _words(place.get("region", "–")),
            number(place.get("z"), ".1f"),
        ]
        for place in where
    ]
    columns = ("channel", "rollout", "time [s]", "region", "z")
    caption = "Windows with the largest deviation of the model; z in standard deviations."
    return [TablePart(columns, rows, caption)]


def _next(experiment: Any) -> list[Section]:
    if not experiment:
        return []
    if not isinstance(experiment, Mapping):
        return [Section("Next experiment", [TextPart(_words(experiment))])]
    rows = [[str(name), _words(value)] for name, value in experiment.items()]
    caption = "A recording that would distinguish the remaining candidates."
    return [Section("Next experiment", [TablePart(("item", "value"), rows, caption, "prose")])]


def _revision(folder: Path, description: Mapping[str, Any]) -> list[Section]:
    """Returns the revised model, as a diff if the previous model is known."""
    file = folder / "revised_model.py"
    if not file.exists():
        return []
    revised = read_text(file)
    model = description.get("model")
    before = model.get("source") if isinstance(model, Mapping) else model
    is_long = len(revised) + len(str(before)) > MAX_COMPARED
    if not isinstance(before, str) or not before.strip() or is_long:
        return [Section("Revised model", [CodePart(revised, "revised_model.py, for MODEL")])]
    lines = difflib.unified_diff(
        before.splitlines(), revised.splitlines(), "model", "revised_model.py", lineterm=""
    )
    caption = "Changes to the model; revised_model.py can be used as MODEL."
    return [Section("Revised model", [DiffPart(list(lines), caption)])]


def _pictures(folder: Path) -> list[Section]:
    parts: list[Part] = []
    left_out, size = [], 0
    for file in sorted(folder.glob("*.png")):
        if size + file.stat().st_size * 4 / 3 > MAX_PICTURE_BYTES:
            left_out.append(file.name)
            continue
        content = base64.b64encode(read_bytes(file)).decode("ascii")
        size += len(content)
        caption = file.stem.replace("_", " ")
        parts.append(PicturePart(f"data:image/png;base64,{content}", caption))
    if left_out:
        parts.append(TextPart(f"Too large for this page: {', '.join(left_out)}."))
    return [Section("Figures", parts)] if parts else []


def _named(effect: Any) -> str:
    if not isinstance(effect, Mapping):
        return str(effect)
    port = effect.get("port")
    return f"{effect.get('effect', 'effect')} at {port}" if port else str(effect.get("effect"))


def _span(value: Any) -> str:
    if isinstance(value, list) and len(value) == 2:
        return f"{number(value[0])} … {number(value[1])}"
    return _words(value) if value is not None else "–"


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_words(item) for item in value)
    return number(value) if isinstance(value, float) else str(value)
