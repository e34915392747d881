"""The result of a discovery in a sentence, for reports and notebooks."""

from collections.abc import Mapping, Sequence
from typing import Any

from npdr_ppl.drawing.bars_html import METRICS
from npdr_ppl.drawing.effect_names import effect_label, in_words, why_unnamed
from npdr_ppl.drawing.numbers import number

__all__ = ["headline", "told_doubt"]

MOST_NAMED = 3
"""Maximum number of effects that the headline names; of more, only the number is given."""


def told_doubt(effect: Mapping[str, Any]) -> str:
    """Returns why an effect was not found again, to follow its name in a sentence.

    Empty if it was. Earlier versions named no effect that any part of the recording does not show.

    Args:
        effect: The effect in ``discovery.json``.
    """
    if "doubt" in effect:
        return str(effect["doubt"] or "")
    parts = [part["part"] for part in effect.get("found_in") or [] if not part["is_found"]]
    return f"was not found in {parts[0]}" if parts else ""


def headline(result: Mapping[str, Any]) -> tuple[str, str]:
    """Returns the verdict in a few words, and a sentence that says what it rests on.

    Args:
        result: Content of ``discovery.json``.
    """
    word = str(result.get("verdict", "no verdict"))
    effects = result.get("effects") or []
    large = [e for e in effects if not why_unnamed(e) and not told_doubt(e)] or effects
    names = result.get("named") or ()
    named = [e for e in large if f"{e.get('port')}.{e.get('effect')}" in names]
    labels = [effect_label(effect) for effect in named or large]
    p_value = number((result.get("alarm") or {}).get("p_value"))
    gained = _gained(result.get("gap") or {})
    reason = in_words(str(result.get("reason") or ""))
    best = labels[0] if labels else "an effect"
    why = _shortened(reason, len(effects))
    verdicts = {
        "none": (
            "No effect is missing",
            reason
            if effects
            else f"The present model explains the recording (alarm: p = {p_value}).",
        ),
        "named": (f"Missing: {_listed(labels) or 'an effect'}", gained),
        "ambiguous": (
            f"Missing: {best}, or another cause",
            f"The recording does not show which. {gained}",
        ),
        "unknown": (
            "Something unknown is missing",
            why or "No effect of the catalogue explains the recording.",
        ),
        "learned": (f"Learned: {_laws(result) or 'a law'}", gained),
    }
    return verdicts.get(word, (word, reason))


def _laws(result: Mapping[str, Any]) -> str:
    """Returns the learned laws in words: the first one, and how many more there are."""
    laws = (result.get("learned") or {}).get("laws") or []
    texts = [f"{law['with_numbers']} {law['unit']} at {law['port']}" for law in laws]
    return texts[0] + (f", and {len(texts) - 1} more" if len(texts) > 1 else "") if texts else ""


def _shortened(reason: str, num_effects: int) -> str:
    """Returns a reason; without the list of effects if there are many, for the table has them."""
    start = "The best explanation so far is "
    head, found, rest = reason.partition(start)
    if not found or num_effects <= MOST_NAMED:
        return reason
    tail = rest.split("; ", 1)[-1] if "; " in rest else ""
    return f"{head}The best explanation so far has {num_effects} effects; {tail}"


def _listed(labels: Sequence[str]) -> str:
    if len(labels) > MOST_NAMED:
        return f"{labels[0]}, and {len(labels) - 1} more effects"
    if len(labels) > 1:
        return f"{', '.join(labels[:-1])}, and {labels[-1]}"
    return "".join(labels)


def _gained(gap: Mapping[str, Any]) -> str:
    """Returns a sentence about the gain of the revised model on held-out rollouts."""
    if not gap:
        return "The gain on held-out rollouts was not measured."
    shares = {
        METRICS.get(metric, metric): values["closed"]
        for metric, values in gap.items()
        if values.get("closed") is not None
    }
    if not shares:
        return "On held-out rollouts the original model has hardly any gap to close."
    closed = [f"{min(share, 1.0):.0%} in {name}" for name, share in shares.items() if share >= 0.0]
    grown = [name for name, share in shares.items() if share < 0.0]
    sentences = []
    if closed:
        sentences.append(
            f"Of the gap on held-out rollouts the revised model closes {', '.join(closed)}."
        )
    if grown:
        sentences.append(f"The error on held-out rollouts has grown in {', '.join(grown)}.")
    return " ".join(sentences)
