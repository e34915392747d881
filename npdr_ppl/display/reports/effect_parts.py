"""The effects that a discovery found: a short table, and details behind a click."""

from collections.abc import Mapping, Sequence
from typing import Any

from npdr_ppl.display.reports.content import (
    DrawingPart,
    FoldedPart,
    Part,
    Section,
    TablePart,
    TextPart,
)
from npdr_ppl.drawing.bars_html import named_bars
from npdr_ppl.drawing.effect_names import (
    cause_in_words,
    effect_label,
    effect_title,
    in_words,
    why_unnamed,
)
from npdr_ppl.drawing.numbers import interval, number, uncertain

__all__ = ["effects_section", "estimates_section"]

MOST_ALTERNATIVES = 3
"""Maximum number of causes that are listed beside an effect; of more, only the number is given."""

MOST_BARS = 12
"""Maximum number of candidates in a drawing."""

Rows = Sequence[Mapping[str, Any]]


def effects_section(effects: Rows, ranking: Rows) -> Section:
    """Returns the effects in words, with their parameters and alternatives."""
    if not effects:
        parts: list[Part] = [TextPart("No effect was added.")]
        return Section("Effects", parts + _tested(ranking))
    rows = [
        [
            effect_label(effect),
            number(effect.get("probability"), ".0%"),
            number(effect.get("share"), ".0%") + _bracketed(why_unnamed(effect)),
            _others(effect.get("equivalent_to") or []),
        ]
        for effect in effects
    ]
    columns = ("effect", "probability", "share of the misfit", "could also be")
    captions = {
        "Small effects are in the revised model, but are not named.": any(
            why_unnamed(effect) == "small" for effect in effects
        ),
        "An effect that corrects a number of the model is not missing. That number was no "
        "parameter, because recordings determine it only together with the other effects.": any(
            effect.get("corrects") for effect in effects
        ),
    }
    caption = " ".join(text for text, is_needed in captions.items() if is_needed)
    folded = [*_parameters(effects), *_repeated(effects), *_found_in(effects)]
    parts = [TablePart(columns, rows, caption)]
    if folded:
        parts.append(
            FoldedPart("Parameters of the effects, and whether each was repeated", folded)
        )
    return Section("Effects", parts + _alternatives(effects) + _tested(ranking))


def estimates_section(parameters: Mapping[str, Any]) -> list[Section]:
    """Returns the parameters of the revised model that are no effect's."""
    rows = [
        [
            f"{name.replace('_', ' ')}{_unit(row)}",
            uncertain(row.get("mean"), row.get("sd")),
            number(row.get("sd"), ".2g"),
            _interval(row),
        ]
        for name, row in parameters.items()
        if "." not in name
    ]
    if not rows:
        return []
    columns = ("parameter", "mean", "sd", "94 % interval")
    return [
        Section("Parameters of the model", [TablePart(columns, rows, "In the revised model.")])
    ]


def _bracketed(why: str) -> str:
    return f" ({why})" if why else ""


def _others(names: Sequence[Any]) -> str:
    words = [cause_in_words(str(name)) for name in names]
    more = len(words) - MOST_ALTERNATIVES
    shown = ", ".join(words[:MOST_ALTERNATIVES])
    return f"{shown} and {more} more" if more > 0 else shown or "–"


def _parameters(effects: Rows) -> list[Part]:
    rows = [
        [
            f"{_named(effect)}: {name.replace('_', ' ')}{_unit(row)}",
            uncertain(row.get("mean"), row.get("sd")),
            number(row.get("sd"), ".2g"),
            _interval(row),
        ]
        for effect in effects
        for name, row in (effect.get("parameters") or {}).items()
    ]
    rows += [
        [f"{_named(effect)}: {name.replace('_', ' ')}", number(value, ".4g"), "–", "–"]
        for effect in effects
        for name, value in (effect.get("constants") or {}).items()
    ]
    columns = ("parameter", "mean", "sd", "94 % interval")
    return [TablePart(columns, rows, "Parameters of the effects.")] if rows else []


def _repeated(effects: Rows) -> list[Part]:
    rows = [
        [
            f"{_named(effect)}: {name.replace('_', ' ')}",
            str(part.get("part")),
            f"{uncertain(value.get('mean'), value.get('sd'))} ± {number(value.get('sd'), '.2g')}",
        ]
        for effect in effects
        for part in effect.get("parts") or []
        for name, value in (part.get("strengths") or {}).items()
    ]
    caption = "Found again? Strengths in the two parts of the recording that differ most."
    return [TablePart(("strength", "part", "mean ± sd"), rows, caption)] if rows else []


def _found_in(effects: Rows) -> list[Part]:
    rows = [
        [
            _named(effect),
            str(part.get("part")),
            _shown_in(part),
            number(part.get("probability"), ".0%"),
            in_words(str(part.get("instead") or "")) or "–",
        ]
        for effect in effects
        for part in effect.get("found_in") or []
    ]
    columns = ("effect", "part", "found", "probability", "explained better by")
    caption = (
        "Does a part of the recording alone show the effect? The probability is that of the "
        "effect against the model without it, in this part."
    )
    return [TablePart(columns, rows, caption)] if rows else []


def _shown_in(part: Mapping[str, Any]) -> str:
    """Returns what a part of the recording says about an effect."""
    if part.get("is_found"):
        return "yes"
    if part.get("contradicts") or part.get("instead"):
        return "no, contradicts it"
    # Earlier versions did not tell the two apart.
    return "no, too weak to show it" if "contradicts" in part else "no"


def _alternatives(effects: Rows) -> list[Part]:
    """Returns the probabilities of each effect and of what could replace it."""
    parts: list[Part] = []
    for effect in effects:
        found = {
            (in_words(name) if name else "nothing"): float(p)
            for name, p in (effect.get("alternatives") or {}).items()
            if p is not None
        }
        if len(found) > 1:
            best = dict(sorted(found.items(), key=lambda item: -item[1])[:MOST_BARS])
            caption = f"Probabilities of the causes instead of {_named(effect)}."
            parts.append(DrawingPart(named_bars(best, most=1.0), caption))
    return [FoldedPart("What else each effect could be", parts)] if parts else []


def _tested(ranking: Rows) -> list[Part]:
    """Returns the candidates for the original model, each alone."""
    scored = {
        _named(row): float(row[key])
        for row in ranking
        for key in ("separation", "probability")
        if row.get(key) is not None
    }
    if not scored:
        return []
    best = dict(sorted(scored.items(), key=lambda item: -item[1])[:MOST_BARS])
    caption = (
        "How clearly each candidate alone would improve the original model, the clearest first"
    )
    is_separation = any(row.get("separation") is not None for row in ranking)
    caption += ", in standard deviations of the measurements." if is_separation else "."
    drawing = named_bars(best, spec=".3g" if is_separation else ".0%")
    return [FoldedPart("Candidates that were tested", [DrawingPart(drawing, caption)])]


def _named(effect: Mapping[str, Any]) -> str:
    return effect_title(str(effect.get("effect", "effect")), str(effect.get("port") or ""))


def _unit(row: Mapping[str, Any]) -> str:
    unit = row.get("unit") or ""
    return f" [{unit}]" if unit not in ("", "1") else ""


def _interval(row: Mapping[str, Any]) -> str:
    return interval(row.get("hdi_94") or [])
