"""Curves over time as HTML with vector graphics: readable at any width, light and dark.

The graphics stretch with the page; the labels are text beside them, which keeps its size. Nothing
needs a script, so the same drawing is used by reports, by notebooks and on paper.
"""

import math
from collections.abc import Mapping, Sequence
from html import escape

from npdr_ppl.drawing.numbers import number

__all__ = ["curve", "keys"]

Series = Sequence[float | None]

WIDTH, HEIGHT, ERROR_HEIGHT = 1000, 140, 56
"""Size of the drawings in their own units; heights are CSS pixels, too."""

LABELS = {
    "measured": "measured",
    "nominal": "nominal: middle of the priors",
    "fitted": "fitted: before",
    "revised": "revised: after",
}
"""Words for the series; the keys are their classes in the style."""

LABEL_ROOM = 7
"""Least distance in CSS pixels of a label from the drawing's edge: half a line of 12 px."""

MARGIN = 0.06
"""Space above and below the curves, as a share of their range."""

MOST_OF_RANGE = 3.0
"""Greatest range of a drawing, in ranges of the measurement: a simulation that runs away is cut
off there, so that the measurement stays visible."""


def keys(names: Sequence[str]) -> str:
    """Returns the legend of some of the series in ``LABELS``."""
    items = "".join(f'<span><i class="{name}"></i>{LABELS[name]}</span>' for name in names)
    return f'<div class="keys">{items}</div>'


def curve(
    time: Sequence[float],
    series: Mapping[str, Series],
    *,
    title: str,
    errors: Mapping[str, Series] | None = None,
    note: str = "",
    height: int = HEIGHT,
) -> str:
    """Draws one channel over time, and below it the errors of simulations.

    Args:
        time: Seconds, ``(T,)``.
        series: ``measured`` and simulations by name, ``(T,)`` each; ``None`` for a missing value.
        title: Name and unit of the channel.
        errors: Simulation minus measurement by name, ``(T,)`` each.
        note: Text behind the title.
        height: Height of the upper drawing in CSS pixels.
    """
    if not len(time) or not _known(series.get("measured", ())):
        return ""
    span = time[0], max(time[-1], time[0] + 1e-9)
    bounds = _bounds(series)
    order = [name for name in ("nominal", "fitted", "revised", "measured") if name in series]
    # The measurement is the widest curve and lies below the revised model's, which may cover it.
    order.sort(key=("nominal", "measured", "fitted", "revised").index)
    head = f'<div class="name"><b>{escape(title)}</b> <small>{escape(note)}</small></div>'
    parts = [head, *_panel(time, {n: series[n] for n in order}, span, bounds, height, title)]
    if errors:
        parts += _panel(
            time, errors, span, _error_bounds(errors), ERROR_HEIGHT,
            f"error of {title}", kind="error",
        )  # fmt: skip
    parts.append(_time_axis(span))
    return f'<div class="curve">{"".join(parts)}</div>'


def _panel(
    time: Sequence[float],
    series: Mapping[str, Series],
    span: tuple[float, float],
    bounds: tuple[float, float],
    height: int,
    title: str,
    kind: str = "",
) -> list[str]:
    """Returns the labels on the left, and the curves."""
    low, high = bounds
    # A label at the edge would overlap what is above or below the drawing.
    room = LABEL_ROOM * (high - low) / height
    ticks = _ticks(low + room, high - room, most=8 if kind == "error" else 5)
    if kind == "error":
        ticks = [ticks[0], 0.0, ticks[-1]]
    places = [(height * (1.0 - (t - low) / (high - low)), t) for t in ticks]
    lines = "".join(f"M0 {y:.1f}H{WIDTH}" for y, _ in places)
    paths = "".join(
        f'<path class="{name}" d="{_path(time, values, span, bounds, height)}"/>'
        for name, values in series.items()
    )
    shown = [
        f'<span style="top:{100 * y / height:.1f}%">{escape(_tick(t, ticks))}</span>'
        for y, t in places
    ]
    return [
        f'<div class="ticks y {kind}">{"".join(shown)}</div>',
        f'<svg class="{kind}" viewBox="0 0 {WIDTH} {height}" preserveAspectRatio="none" '
        f'style="height:{height}px" role="img" aria-label="{escape(title)}">'
        f'<path class="grid" d="{lines}"/>{paths}</svg>',
    ]


def _time_axis(span: tuple[float, float]) -> str:
    low, high = span
    ticks = [t for t in _ticks(low, high, most=5) if t < high - 0.12 * (high - low)]
    places = [(100.0 * (t - low) / (high - low), _tick(t, ticks)) for t in ticks]
    places.append((100.0, f"{number(high, '.3g')} s"))
    spans = "".join(f'<span style="left:{x:.1f}%">{escape(word)}</span>' for x, word in places)
    return f'<div class="ticks x">{spans}</div>'


def _path(
    time: Sequence[float],
    values: Series,
    span: tuple[float, float],
    bounds: tuple[float, float],
    height: int,
) -> str:
    """Returns the commands of a path; a missing value interrupts the line."""
    commands, is_down = [], False
    across, (low, high) = WIDTH / (span[1] - span[0]), bounds
    for t, value in zip(time, values, strict=True):
        if value is None:
            is_down = False
            continue
        # Far outside the drawing, only the direction matters.
        level = min(max((value - low) / (high - low), -1.0), 2.0)
        x, y = across * (t - span[0]), height * (1.0 - level)
        commands.append(f"{'L' if is_down else 'M'}{x:.1f} {y:.1f}")
        is_down = True
    return "".join(commands)


def _bounds(series: Mapping[str, Series]) -> tuple[float, float]:
    """Returns the range of all curves, limited about the measurement's."""
    measured = _known(series["measured"])
    low, high = min(measured), max(measured)
    size = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-12)
    # A constant measurement, as of a joint that is held, has no range to compare with.
    room = 0.5 * (MOST_OF_RANGE - 1.0) * size if high > low else math.inf
    every = [v for values in series.values() for v in _known(values)]
    low, high = max(min(every), low - room), min(max(every), high + room)
    margin = MARGIN * max(high - low, size)
    return low - margin, high + margin


def _error_bounds(errors: Mapping[str, Series]) -> tuple[float, float]:
    """Returns a symmetric range that contains nearly all errors of the fitted model."""
    every = sorted(abs(v) for values in errors.values() for v in _known(values))
    most = every[int(0.995 * (len(every) - 1))] if every else 0.0
    most = 1.05 * most or 1.0
    return -most, most


def _known(values: Series) -> list[float]:
    return [v for v in values if v is not None]


def _ticks(low: float, high: float, *, most: int) -> list[float]:
    """Returns round numbers between two bounds, ``most`` or fewer."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1, 2, 2.5, 5, 10) if power * m >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def _tick(value: float, ticks: Sequence[float]) -> str:
    """Returns a tick's label; zero is not ``1e-17``."""
    step = ticks[1] - ticks[0] if len(ticks) > 1 else abs(value)
    return number(0.0 if abs(value) < 1e-6 * step else value, ".4g")
