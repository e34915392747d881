"""Charts as plain Plotly specifications: traces and layouts of JSON types.

They are dictionaries rather than Plotly's own objects, so that writing a report does not import
most of that library. The tests check them with Plotly.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.display.reports.content import ChartPart
from npdr_ppl.drawing.marginal import density
from npdr_ppl.drawing.theme import COLORS, SERIES

__all__ = [
    "bands_chart",
    "bars_chart",
    "drawn_points",
    "intervals_chart",
    "layout_of",
    "lines_chart",
    "marginals_chart",
    "matrix_chart",
    "pit_chart",
    "rounded",
]

Array = NDArray[np.float64]

MAX_POINTS = 400
"""Maximum number of points of a line; a phone shows no more, and the page must stay small."""

MAX_MARKERS = 40
"""Maximum number of marked points of a line; more would hide the line."""

_GRID = 120
_BINS = 20
_BANDS = ((0.05, 0.95, "rgba(0,114,178,0.22)"), (0.25, 0.75, "rgba(0,114,178,0.4)"))
_DIGITS = 5


def rounded(values: Any) -> list[Any]:
    """Returns numbers with five digits; None for NaN and infinity, which JSON lacks."""
    flat = np.asarray(values, dtype=float)
    if flat.ndim > 1:
        return [rounded(row) for row in flat]
    return [float(f"{v:.{_DIGITS}g}") if np.isfinite(v) else None for v in flat.tolist()]


def marginals_chart(
    posterior: Mapping[str, Array], prior: Mapping[str, Array], units: Mapping[str, str]
) -> ChartPart:
    """Draws marginals of the posterior over the prior; a menu chooses the parameter."""
    names = list(posterior)
    data: list[dict[str, Any]] = []
    for index, name in enumerate(names):
        together = np.concatenate([posterior[name], prior[name]])
        grid = np.linspace(together.min(), together.max(), _GRID)
        for label, samples in (("prior", prior[name]), ("posterior", posterior[name])):
            shown = density(samples, grid) if samples.std() > 0 else np.full(_GRID, np.nan)
            look = {"fill": "tozeroy", "visible": index == 0}
            data.append(_line(label, grid, shown, {"color": COLORS[label]}, **look))
    titles = [_with_unit(name, units.get(name, "")) for name in names]
    buttons = [
        {
            "label": name,
            "method": "update",
            "args": [
                {"visible": [index == row for row in range(len(names)) for _ in range(2)]},
                {"xaxis.title.text": titles[index]},
            ],
        }
        for index, name in enumerate(names)
    ]
    menu: dict[str, Any] = {"buttons": buttons, "bgcolor": "#8c959f", "font": {"color": "#000000"}}
    menu |= {"x": 0.0, "xanchor": "left", "y": 1.22, "yanchor": "top"}
    layout = layout_of(titles[0] if titles else "", "density")
    layout["yaxis"] |= {"showticklabels": False, "rangemode": "tozero"}
    layout["margin"] |= {"t": 60, "b": 80}
    layout["legend"] |= {"y": -0.25, "yanchor": "top"}
    layout["updatemenus"] = [menu] if len(names) > 1 else []
    caption = "Marginal posterior over the prior; equal if the data contain no information."
    return ChartPart("marginals", caption, data, layout, 360)


def intervals_chart(
    name: str,
    rows: Mapping[str, tuple[float, float, float]],
    *,
    title: str,
    caption: str,
) -> ChartPart:
    """Draws intervals as horizontal bars about their middle, ``label: (low, middle, high)``."""
    labels = list(rows)
    values = np.array([rows[label] for label in labels], dtype=float).reshape(-1, 3)
    data = [
        {
            "type": "scatter",
            "mode": "markers",
            "x": rounded(values[:, 1]),
            "y": labels,
            "marker": {"color": COLORS["posterior"], "size": 9},
            "showlegend": False,
            "error_x": {
                "type": "data",
                "symmetric": False,
                "array": rounded(values[:, 2] - values[:, 1]),
                "arrayminus": rounded(values[:, 1] - values[:, 0]),
            },
        }
    ]
    layout = layout_of(title, "")
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    return ChartPart(name, caption, data, layout, 130 + 28 * len(labels))


def bars_chart(
    name: str, bars: Mapping[str, Mapping[str, float]], *, title: str, caption: str
) -> ChartPart:
    """Draws horizontal bars, ``series: {label: value}``; several series are stacked."""
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "name": series,
            "y": list(values),
            "x": rounded(list(values.values())),
            "marker": {"color": SERIES[index % len(SERIES)]},
            "showlegend": len(bars) > 1,
        }
        for index, (series, values) in enumerate(bars.items())
    ]
    layout = layout_of(title, "")
    layout["barmode"] = "stack"
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    count = max((len(values) for values in bars.values()), default=0)
    return ChartPart(name, caption, data, layout, 140 + 28 * count)


def drawn_points(num: int) -> slice:
    """Returns the points of a line that are drawn, evenly spread and ``MAX_POINTS`` at most."""
    return slice(None, None, max(1, -(-num // MAX_POINTS)))


def lines_chart(
    name: str,
    lines: Mapping[str, tuple[Sequence[float], Sequence[float | None]]],
    *,
    titles: tuple[str, str],
    caption: str,
    diagonal: bool = False,
) -> ChartPart:
    """Draws lines with markers, ``label: (x, y)``, optionally with the diagonal."""
    data = []
    for index, (label, (x, y)) in enumerate(lines.items()):
        color = SERIES[index % len(SERIES)]
        line = _line(label, x, [np.nan if v is None else v for v in y], {"color": color})
        line["mode"] = "lines+markers" if len(x) <= MAX_MARKERS else "lines"
        # Black is invisible on a dark page.
        data.append(line | ({"meta": "ink"} if color == "#000000" else {}))
    if diagonal:
        data.append(_ideal((0, 1)))
    return ChartPart(name, caption, data, layout_of(*titles), 340)


def bands_chart(
    name: str, time: Array, measured: Array, predictive: Array, *, titles: tuple[str, str]
) -> ChartPart:
    """Draws the predictive bands of one channel and the recording.

    Args:
        name: Identifier on the page.
        time: Seconds or steps, ``(T,)``.
        measured: The recording, ``(T,)``.
        predictive: Draws, ``(n, T)``.
        titles: Of the axes.
    """
    kept = drawn_points(len(time))
    data: list[dict[str, Any]] = []
    for low, high, color in _BANDS:
        bounds = np.quantile(predictive[:, kept], [low, high], axis=0)
        for bound, fill in zip(bounds, ("none", "tonexty"), strict=True):
            look = {"fill": fill, "fillcolor": color, "hoverinfo": "skip"}
            look |= {"showlegend": fill == "tonexty"}
            label = f"posterior {high - low:.0%}"
            data.append(_line(label, time[kept], bound, {"width": 0}, **look))
    data.append(_line("measured", time[kept], measured[kept], {"width": 1.5}, meta="ink"))
    caption = f"{titles[1]}: measurement over the prediction of the fitted model."
    return ChartPart(name, caption, data, layout_of(*titles), 300)


def pit_chart(pit: Array) -> ChartPart:
    """Draws the histogram of probability integral transforms, ``(measurements,)``."""
    counts, edges = np.histogram(pit, bins=_BINS, range=(0.0, 1.0))
    share = counts * _BINS / max(1, counts.sum())
    data: list[dict[str, Any]] = [
        {
            "type": "bar",
            "x": rounded((edges[1:] + edges[:-1]) / 2),
            "y": rounded(share),
            "marker": {"color": COLORS["posterior"]},
            "showlegend": False,
        },
        _ideal((1, 1)),
    ]
    caption = (
        "Ranks of the measurements in the predictive distribution. Flat at 1 is ideal; a hill "
        "means too wide predictions, a valley too narrow ones, a slope a bias."
    )
    layout = layout_of("share of predictions below the measurement", "density") | {"bargap": 0.05}
    return ChartPart("pit", caption, data, layout, 280)


def matrix_chart(samples: Mapping[str, Array]) -> ChartPart:
    """Draws the correlations between parameters."""
    names = list(samples)
    # A parameter without spread has no correlation.
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = np.corrcoef(np.stack([samples[name] for name in names]))
    data = [
        {
            "type": "heatmap",
            "x": names,
            "y": names,
            "z": rounded(matrix),
            "zmin": -1,
            "zmax": 1,
            "colorscale": "RdBu",
            "reversescale": True,
            "colorbar": {"thickness": 12},
        }
    ]
    layout = layout_of("", "")
    layout["xaxis"] |= {"automargin": True}
    layout["yaxis"] |= {"automargin": True, "autorange": "reversed"}
    caption = (
        "Correlation of parameters in the posterior. Close to ±1, the data determine only a "
        "combination of the two."
    )
    return ChartPart("correlations", caption, data, layout, 420)


def layout_of(x: str, y: str) -> dict[str, Any]:
    """Returns a layout with titles of the axes."""
    return {
        "margin": {"l": 55, "r": 15, "t": 20, "b": 50},
        "xaxis": {"title": {"text": x}},
        "yaxis": {"title": {"text": y}},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
    }


def _line(name: str, x: Any, y: Any, line: dict[str, Any], **look: Any) -> dict[str, Any]:
    """Returns a line, with its colour, width or dashes and further properties of the trace."""
    trace = {"type": "scatter", "mode": "lines", "name": name, "x": rounded(x), "y": rounded(y)}
    return trace | {"line": line} | look


def _ideal(y: tuple[float, float]) -> dict[str, Any]:
    """Returns the line of a perfect result from 0 to 1."""
    return _line("as it should be", (0, 1), y, {"dash": "dot", "width": 1}, meta="ink")


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit and unit != "1" else name
