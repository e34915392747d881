"""The part of a report that shows learned laws."""

from collections.abc import Mapping
from typing import Any

from npdr_ppl.display.reports.content import Part, Section, TablePart, TextPart
from npdr_ppl.drawing.effect_names import in_words
from npdr_ppl.drawing.numbers import number

__all__ = ["learned_section"]


def learned_section(learned: Mapping[str, Any]) -> list[Section]:
    """Returns the laws, their constants, what they depend on, and where they were checked.

    Args:
        learned: What ``discovery.json`` has under ``learned``; empty if nothing was learned.
    """
    if not learned:
        return []
    parts: list[Part] = [TextPart(str(learned.get("reason") or ""))]
    for law in learned.get("laws") or []:
        parts += _law(law, learned)
    checks = [
        [str(check.get("where")), number(check.get("before")), number(check.get("after"))]
        for check in learned.get("checks") or []
    ]
    caption = (
        "Misfit over the number of measurements, where the law was not fitted. The model of each "
        "half is fitted to the other half."
    )
    parts.append(TablePart(("measurements", "without the law", "with the law"), checks, caption))
    title = "Learned law" if learned.get("offered") else "Learned law, not offered"
    return [Section(title, parts)]


def _law(law: Mapping[str, Any], learned: Mapping[str, Any]) -> list[Part]:
    port, ranges = str(law.get("port")), law.get("ranges") or {}
    rows = [
        [str(name), number(constant.get("value")), str(constant.get("unit"))]
        for name, constant in (law.get("constants") or {}).items()
    ]
    where = ", ".join(
        f"{symbol} from {number(low)} to {number(high)}" for symbol, (low, high) in ranges.items()
    )
    parts: list[Part] = [
        TablePart(
            ("constant", "value", "unit"), rows, f"{law.get('formula')} at {port}; for {where}."
        )
    ]
    meanings = [f"{letter} is {about}." for letter, about in (law.get("letters") or {}).items()]
    if meanings:
        parts.append(TextPart(" ".join(meanings)))
    shares = (learned.get("depends_on") or {}).get(port) or {}
    if shares:
        words = ", ".join(f"{symbol} {number(share, '.0%')}" for symbol, share in shares.items())
        parts.append(TextPart(f"Explained misfit that is lost without each variable: {words}."))
    like = (learned.get("alike") or {}).get(port)
    if like:
        correlation = number(like.get("correlation"), ".2f")
        effect = in_words(str(like.get("effect")))
        parts.append(
            TextPart(f"Most similar in the catalogue: {effect}, correlation {correlation}.")
        )
    return parts
