"""How a discovery appears in a notebook: verdict, curves, gap, effects; and two drawings."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from npdr_ppl.discovery.finding import Finding
from npdr_ppl.discovery.headline import headline
from npdr_ppl.discovery.proof.held_out_gap import Gap
from npdr_ppl.discovery.proof.settings import GAP
from npdr_ppl.drawing.bars_html import gap_bars
from npdr_ppl.drawing.effect_names import cause_in_words, effect_title
from npdr_ppl.drawing.html import table
from npdr_ppl.drawing.numbers import number
from npdr_ppl.drawing.overlay_html import lead_html
from npdr_ppl.drawing.page_style import styled
from npdr_ppl.drawing.panels import panels
from npdr_ppl.drawing.theme import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["discovery_html", "draw_gap", "draw_probabilities", "plot_discovery", "short_name"]

MOST_BARS = 5
"""Greatest number of alternatives drawn for one effect."""

CHOSEN, OTHERS, BEFORE = COLORS["posterior"], COLORS["prior"], COLORS["nominal"]


def short_name(name: str) -> str:
    """Returns an effect's name in two lines: the effect and its port."""
    port, _, effect = name.rpartition(".")
    channels = port.split(",")
    where = ", ".join(channels) if len(channels) < 3 else f"{channels[0]} … {channels[-1]}"
    return f"{effect.replace('_', ' ')}\n{where}"


def plot_discovery(
    verdict: str,
    effects: Sequence[Finding],
    weights: Mapping[str, float],
    gap: Mapping[str, Gap],
    axes: Any = None,
) -> Any:
    """Draws the findings and the gap; see :meth:`Discovery.plot`.

    Args:
        verdict: The verdict in one word.
        effects: The effects that were found.
        weights: Probabilities of the candidates that were tried last, by name.
        gap: Metrics on the held-out recording.
        axes: Axes to draw on; ``None`` makes a figure.
    """
    shown = probabilities(effects, weights)
    metrics = {m: values for m, values in gap.items() if values.noise_floor is not None}
    count = max(1, len(shown) + len(metrics))
    given = panels(axes, count, columns=count, size=(2.8, 2.6))
    given[0].set_title(f"verdict: {verdict}")
    for axis, (title, bars, chosen) in zip(given, shown, strict=False):
        draw_probabilities(axis, bars, chosen=chosen, title=title)
    for axis, (metric, values) in zip(given[len(shown) :], metrics.items(), strict=False):
        draw_gap(axis, metric, values)
        axis.legend()
    return given


def probabilities(
    effects: Sequence[Finding], weights: Mapping[str, float]
) -> list[tuple[str, Mapping[str, float], Sequence[str]]]:
    """Returns title, probabilities and the chosen name of each panel.

    There is one panel for each effect that was found, with its alternatives. If none was found,
    one panel has the candidates that were tried, if any; ``""`` stands for no effect.
    """
    if effects:
        return [
            (f"what effect {k} could be", f.alternatives, (f.effect.name,))
            for k, f in enumerate(effects, start=1)
        ]
    return [("nothing was added", weights, ("",))] if weights else []


def draw_probabilities(
    axis: "Axes", bars: Mapping[str, float], *, chosen: Sequence[str], title: str = ""
) -> None:
    """Draws probabilities as horizontal bars, the greatest on top.

    Args:
        axis: Axis to draw on.
        bars: Probabilities by name of the effect; ``""`` for no effect.
        chosen: Names of the chosen effects, whose bars get a colour of their own.
        title: Title of the panel.
    """
    names = sorted(bars, key=lambda name: -bars[name])[:MOST_BARS]
    values = [bars[name] for name in names]
    colors = [CHOSEN if name in chosen else OTHERS for name in names]
    axis.barh(range(len(names)), values, color=colors, height=0.7)
    for row, value in enumerate(values):
        axis.text(value, row, f" {value:.0%}", va="center", fontsize=7)
    axis.set_yticks(range(len(names)), [short_name(n) if n else "none" for n in names], fontsize=7)
    axis.set_xlim(0.0, 1.15)
    axis.set_xticks([0.0, 0.5, 1.0])
    axis.set_ylim(max(len(names), 2) - 0.4, -0.6)
    axis.set_xlabel("probability")
    axis.set_title(title)


def draw_gap(axis: "Axes", metric: str, gap: Gap) -> None:
    """Draws a metric on held-out rollouts before and after, and its target.

    Args:
        axis: Axis to draw on.
        metric: The metric's name.
        gap: The metric's values.
    """
    values = [gap.before, gap.after]
    axis.bar([0, 1], values, color=[BEFORE, CHOSEN], width=0.65)
    if gap.noise_floor is not None:
        axis.axhline(gap.noise_floor, color="k", ls="--", lw=1.0, label="noise floor")
    elif metric == "coverage":
        axis.axhline(GAP.level, color="k", ls=":", lw=1.2, label="what it should be")
    # Below the axis, where no line crosses the numbers.
    axis.set_xticks(
        [0, 1], [f"{w}\n{v:.3g}" for w, v in zip(("before", "after"), values, strict=True)]
    )
    axis.set_xlim(-0.5, 1.5)
    finite = [v for v in (*values, gap.noise_floor or 0.0) if math.isfinite(v)]
    axis.set_ylim(0.0, 1.15 * max([*finite, 1e-12]))
    title = metric.upper() if metric != "coverage" else f"coverage of {GAP.level:.0%} bands"
    closed = gap.closed
    axis.set_title(title if closed is None else f"{title}: {closed:.0%} closed")


def discovery_html(result: Mapping[str, Any], overlays: Mapping[str, Any]) -> str:
    """Returns verdict, curves, gap and effects as HTML, as the report begins.

    Args:
        result: Content of ``discovery.json``.
        overlays: Content of ``overlays.json``.
    """
    word, sentence = headline(result)
    verdict = f"<small>verdict: {escape(str(result['verdict']))}</small>"
    parts = [f"<p><b>{escape(word)}</b><br>{escape(sentence)}<br>{verdict}</p>"]
    if drawn := lead_html(overlays):
        parts.append(f"<div>{escape(drawn[1])}</div>{drawn[0]}")
    parts.append(gap_bars(result.get("gap") or {}))
    effects = result.get("effects") or []
    if effects:
        rows = [row for found in effects for row in _effect_rows(found)]
        head = ["effect", "probability", "parameter", "estimate", "could also be"]
        parts.append(table(head, rows))
    return styled("".join(parts))


def _effect_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """Returns a row per parameter of an effect; the first one has what concerns the effect."""
    values = [
        (name.replace("_", " "), _estimate(row))
        for name, row in (found.get("parameters") or {}).items()
    ]
    values += [(name, f"{v:.4g}") for name, v in (found.get("constants") or {}).items()]
    rows = [["", "", name, value, ""] for name, value in values or [("–", "–")]]
    rows[0][:2] = (
        effect_title(str(found["effect"]), str(found["port"])),
        number(found.get("probability"), ".0%"),
    )
    others = found.get("equivalent_to") or []
    rows[0][-1] = ", ".join(cause_in_words(str(name)) for name in others) or "–"
    return rows


def _estimate(row: Mapping[str, Any]) -> str:
    unit = row.get("unit") or ""
    words = f"{number(row.get('mean'), '.4g')} ± {number(row.get('sd'), '.2g')}"
    return words if unit in ("", "1") else f"{words} {unit}"
