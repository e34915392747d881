"""Measured and simulated curves, and maps of residuals, from ``overlays.json``."""

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from npdr_ppl.display.reports.content import (
    DrawingPart,
    FoldedPart,
    Part,
    Section,
    TablePart,
    TextPart,
)
from npdr_ppl.drawing.heat_html import heat_levels, heat_map, heat_scale
from npdr_ppl.drawing.numbers import number
from npdr_ppl.drawing.overlay_html import channel_html, lead_html, legend_html, rollout_words
from npdr_ppl.errors import DataError
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import OverlayRecord

__all__ = ["lead_curve", "read_overlays", "recording_section", "where_section"]


def read_overlays(folder: Path) -> OverlayRecord | None:
    """Returns the content of ``overlays.json``; ``None`` for runs of versions that wrote none.

    Raises:
        DataError: The file was changed.
    """
    file = folder / "overlays.json"
    if not file.exists():
        return None
    found = read_json(file, OverlayRecord)
    for one in found["rollouts"]:
        lengths = {len(v) for c in one["channels"].values() for v in c.values()}
        if lengths - {len(one["time"])}:
            raise DataError(f"{file} is not what npdr writes: its series differ in length.")
    return found


def lead_curve(overlays: OverlayRecord | None) -> DrawingPart | None:
    """Returns the channel on which the revision helps most, as the drawing of the first screen."""
    found = None if overlays is None else lead_html(overlays)
    return None if found is None else DrawingPart(*found, is_wide=True)


def recording_section(overlays: OverlayRecord | None) -> list[Section]:
    """Returns every channel of every kept rollout; the first rollout is unfolded."""
    if overlays is None or not overlays["rollouts"]:
        return []
    parts: list[Part] = [
        TextPart(
            "Nominal: the middle of the priors. Fitted: the original model with its closest "
            "parameters. Revised: with the effects that were found. The lower drawings show "
            "simulation minus measurement. Rollouts are counted from 0, those held out by "
            "themselves."
        )
    ]
    for place, one in enumerate(overlays["rollouts"]):
        every = "".join(channel_html(one, name, overlays) for name in one["channels"])
        drawings = f'{legend_html(one)}<div class="many">{every}</div>'
        part = DrawingPart(drawings, f"{rollout_words(one, overlays).capitalize()}.")
        parts.append(part if place == 0 else FoldedPart(part.caption.removesuffix("."), [part]))
    return [Section("Measured and simulated", parts)]


def where_section(overlays: OverlayRecord | None, where: Sequence[Mapping[str, Any]]) -> Section:
    """Returns the map of residuals, and the worst windows behind a click."""
    parts: list[Part] = []
    maps, channels = ([], []) if overlays is None else (overlays["maps"], overlays["channels"])
    levels = heat_levels([one[key] for one in maps for key in ("before", "after")])
    for place, one in enumerate(maps):
        name = f"rollout {one['rollout']}"
        drawings = [
            heat_map(one[key], channels, levels, title=f"{name}, {w}", seconds=one["seconds"])
            for key, w in (("before", "original model"), ("after", "revised model"))
        ]
        if one["before"] == one["after"]:
            drawings = drawings[:1]
        caption = (
            "Errors of the fitted models along the recording that was searched, in standard "
            "deviations of the measurement noise. Without colour: as small as noise."
        )
        part = DrawingPart(heat_scale(levels) + "".join(drawings), caption if place == 0 else "")
        parts.append(part if place == 0 else FoldedPart(name.capitalize(), [part]))
    if where:
        summary = f"The {len(where)} windows with the largest errors"
        parts.append(FoldedPart(summary, [_windows(where)]) if maps else _windows(where))
        parts.append(FoldedPart("States and commands in these windows", [_regions(where)]))
    return Section("Where", parts or [TextPart("No window deviates significantly.")])


def _windows(where: Sequence[Mapping[str, Any]]) -> TablePart:
    rows = [
        [
            str(place.get("channel", "–")).replace("_", " "),
            str(place.get("rollout", "–")),
            _span(place.get("time_span", place.get("time"))),
            number(place.get("z"), ".1f"),
        ]
        for place in where
    ]
    columns = ("channel", "rollout", "time [s]", "error / noise")
    return TablePart(columns, rows, "Windows in which the original model fits worst.")


def _regions(where: Sequence[Mapping[str, Any]]) -> TablePart:
    """Returns the ranges in the windows; a row per quantity, however many joints there are."""
    split = [_ranges(place.get("region", "")) for place in where]
    names = list(dict.fromkeys(chain.from_iterable(split)))
    rows = [
        [_span(place.get("time_span", place.get("time"))), text or "–"]
        for place, ranges in zip(where, split, strict=True)
        for text in (
            ", ".join(f"{n.replace('_', ' ')} {ranges[n]}".strip() for n in names if n in ranges),
        )
    ]
    return TablePart(("time [s]", "ranges of states and commands"), rows, layout="prose")


def _ranges(region: Any) -> dict[str, str]:
    """Returns the ranges by name of ``"angle 0.1 to 0.2, torque -1 to 1"``."""
    found = {}
    for piece in str(region).split(", "):
        name, _, span = piece.partition(" ")
        if name:
            found[name] = span
    return found


def _span(value: Any) -> str:
    if isinstance(value, list) and len(value) == 2:
        return f"{number(value[0])} … {number(value[1])}"
    return "–" if value is None else str(value)
