"""Bars as HTML: the gap before and after a revision, and probabilities."""

import math
from collections.abc import Mapping
from html import escape
from typing import Any

from npdr_ppl.drawing.numbers import number

__all__ = ["METRICS", "gap_bars", "interval_bars", "named_bars"]

METRICS = {
    "rmse": "RMSE",
    "dtw": "DTW distance",
    "crps": "CRPS",
    "coverage": "coverage of the 90 % bands",
}
"""Names of the metrics for readers."""

TARGET = 0.9
"""What the coverage of the 90 % bands should be."""


def gap_bars(gap: Mapping[str, Mapping[str, Any]]) -> str:
    """Draws each metric on held-out rollouts before and after, and its target.

    Args:
        gap: The metrics by name, as ``gap`` in ``discovery.json``.
    """
    parts = []
    for metric, values in gap.items():
        before, after, floor = (values.get(n) for n in ("before", "after", "noise_floor"))
        target = TARGET if metric == "coverage" else floor
        known = [float(v) for v in (before, after, target) if v is not None and math.isfinite(v)]
        if not known or max(known) <= 0.0:
            continue
        most = 1.05 * max(known)
        name = METRICS.get(metric, metric)
        parts.append(f"<b>{escape(name)}{_closed(values.get('closed'))}</b>")
        for word, kind, value in (("before", "fitted", before), ("after", "revised", after)):
            parts.append(_row(word, kind, value, most, target))
    if not parts:
        return ""
    words = "noise floor: error of a perfect model"
    if "coverage" in gap:
        words += f"; of the coverage: {TARGET:.0%}, its target"
    key = f'<div class="keys"><span>┊ {words}</span></div>'
    return f'<div class="gaps">{"".join(parts)}</div>{key}'


def named_bars(bars: Mapping[str, float], *, most: float | None = None, spec: str = ".0%") -> str:
    """Draws named values as horizontal bars.

    Args:
        bars: Values by name; none negative.
        most: Value of a full bar; the largest value if ``None``.
        spec: Format of the values.
    """
    largest = most or max(bars.values(), default=1.0) or 1.0
    rows = "".join(
        f"<span>{escape(name)}</span>{_bar('other', value / largest)}"
        f"<span>{escape(number(value, spec))}</span>"
        for name, value in bars.items()
    )
    return f'<div class="gaps names">{rows}</div>'


def _row(word: str, kind: str, value: Any, most: float, target: float | None) -> str:
    share = value / most if value is not None and math.isfinite(value) else 0.0
    return (
        f"<span>{word}</span>{_bar(kind, share, None if target is None else target / most)}"
        f"<span>{escape(number(value))}</span>"
    )


def _bar(kind: str, share: float, mark: float | None = None) -> str:
    width = 100.0 * min(max(share, 0.0), 1.0)
    line = "" if mark is None else f'<div class="floor" style="left:{100.0 * mark:.1f}%"></div>'
    bar = f'<div class="bar {kind}" style="width:{width:.1f}%"></div>'
    return f'<div class="track">{bar}{line}</div>'


def _closed(share: Any) -> str:
    """Returns the closed share in words; a model may be below the floor by chance."""
    if not isinstance(share, int | float) or not math.isfinite(share):
        return ""
    if share < 0.0:
        return ": the gap has grown"
    return f": {min(share, 1.0):.0%} of the gap closed"


def interval_bars(rows: Mapping[str, tuple[float, float, float]], words: Mapping[str, str]) -> str:
    """Draws intervals of one quantity below each other, to see whether they overlap.

    Args:
        rows: Lower end, middle and upper end by name; all finite.
        words: Text at the right of each, by the same names.
    """
    low, high = min(row[0] for row in rows.values()), max(row[2] for row in rows.values())
    # Equal values without a width would leave no range to draw in.
    margin = 0.05 * max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-12)
    low, high = low - margin, high + margin

    def place(value: float) -> float:
        return 100.0 * (value - low) / (high - low)

    parts = []
    for name, (begin, middle, end) in rows.items():
        # An interval that is narrower than a line stays visible.
        width = max(place(end) - place(begin), 0.5)
        bar = f'<div class="span" style="left:{place(begin):.1f}%;width:{width:.1f}%"></div>'
        dot = f'<div class="dot" style="left:{place(middle):.1f}%"></div>'
        parts.append(
            f'<span>{escape(name)}</span><div class="track">{bar}{dot}</div>'
            f"<span>{escape(words[name])}</span>"
        )
    return f'<div class="gaps names">{"".join(parts)}</div>'
