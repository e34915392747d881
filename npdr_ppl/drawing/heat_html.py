"""A map of residuals as HTML with vector graphics: channels over time."""

from collections.abc import Sequence
from html import escape
from itertools import pairwise

from npdr_ppl.drawing.numbers import number

__all__ = ["heat_levels", "heat_map", "heat_scale"]

FIRST = 1.5
"""Least residual with a colour, in standard deviations of the measurement noise. Residuals of the
true model are about 1."""

LEAST_TOP = 48.0
"""Least bound of the darkest shade: ``FIRST`` doubled five times. A map of small residuals is then
pale, whatever its largest residual."""

SHADES = (0.12, 0.26, 0.42, 0.6, 0.8, 1.0)
"""Opacity of the shades: one colour, stronger where the error is larger, light and dark."""

ROW = 20
"""Height of a channel in CSS pixels, 1.25 of a 16 px em."""

Rows = Sequence[Sequence[float | None]]


def heat_levels(maps: Sequence[Rows]) -> list[float]:
    """Returns the bounds of the shades, the same for all maps of a page.

    They grow by a constant factor up to the residual that one cell in a hundred exceeds.
    """
    known = sorted(v for rows in maps for row in rows for v in row if v is not None)
    top = max(LEAST_TOP, known[int(0.99 * (len(known) - 1))] if known else 0.0)
    last = len(SHADES) - 1
    return [float(f"{FIRST * (top / FIRST) ** (k / last):.2g}") for k in range(last + 1)]


def heat_map(
    rows: Rows, names: Sequence[str], levels: Sequence[float], *, title: str, seconds: float
) -> str:
    """Draws residuals by channel and time.

    Args:
        rows: One row of cells per channel, in standard deviations; ``None`` if not known.
        names: The channels.
        levels: Bounds of the shades, see :func:`heat_levels`.
        title: Heading of the map.
        seconds: Duration in s.
    """
    cells = max((len(row) for row in rows), default=0)
    if not cells:
        return ""
    paths = "".join(
        f'<path stroke="none" fill-opacity="{shade}" d="{_runs(rows, levels, level)}"/>'
        for level, shade in enumerate(SHADES)
    )
    labels = "".join(f"<span>{escape(name.replace('_', ' '))}</span>" for name in names)
    height = ROW * len(rows)
    return (
        f'<div class="heat"><div class="name">{escape(title)}</div>'
        f'<div class="rows">{labels}</div>'
        f'<svg viewBox="0 0 {cells} {len(rows)}" preserveAspectRatio="none" '
        f'style="height:{height}px" role="img" aria-label="{escape(title)}" '
        f'shape-rendering="crispEdges">{paths}</svg>'
        f'<span></span><div class="ticks x"><span style="left:0">0</span>'
        f'<span style="left:50%">{number(0.5 * seconds)}</span>'
        f'<span style="left:100%">{number(seconds)} s</span></div></div>'
    )


def heat_scale(levels: Sequence[float]) -> str:
    """Returns the legend of the maps.

    Args:
        levels: Bounds of the shades, see :func:`heat_levels`.
    """
    words = [f"{low:g}–{high:g}" for low, high in pairwise(levels)] + [f"above {levels[-1]:g}"]
    items = "".join(
        f'<span><i style="opacity:{shade}"></i>{word}</span>'
        for shade, word in zip(SHADES, words, strict=True)
    )
    return f'<div class="scale"><span>error / noise:</span>{items}</div>'


def _runs(rows: Rows, levels: Sequence[float], level: int) -> str:
    """Returns the cells of one shade as rectangles, neighbours joined."""
    parts = []
    for y, row in enumerate(rows):
        start = None
        for x, value in enumerate([*row, None]):
            is_in = value is not None and _level(value, levels) == level
            if is_in and start is None:
                start = x
            elif not is_in and start is not None:
                parts.append(f"M{start} {y}h{x - start}v1h{start - x}z")
                start = None
    return "".join(parts)


def _level(value: float, levels: Sequence[float]) -> int:
    """Returns the index of a residual's shade; -1 below the first."""
    return sum(value >= bound for bound in levels) - 1
