"""Measured and simulated curves, and maps of residuals, from ``overlays.json``."""

import math
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
from npdr_ppl.drawing.curves_html import curve, keys
from npdr_ppl.drawing.heat_html import heat_levels, heat_map, heat_scale
from npdr_ppl.drawing.numbers import number
from npdr_ppl.errors import DataError
from npdr_ppl.run_files import read_json
from npdr_ppl.run_records import OverlayRecord

__all__ = ["lead_curve", "read_overlays", "recording_section", "where_section"]

LEAD_HEIGHT = 150
"""Height in CSS pixels of the drawing at the top, so that verdict, curves and bars fit on a screen
of 1280 by 800."""

MODELS = ("nominal", "fitted", "revised")


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
    if overlays is None or not overlays["rollouts"]:
        return None
    one = overlays["rollouts"][0]
    channel = max(one["channels"], key=lambda name: _gain(one["misfit"], name), default=None)
    if channel is None:
        return None
    is_revised = _is_revised(one["channels"][channel])
    caption = (
        f"{channel.replace('_', ' ')} of {_rollout_words(one, overlays)}, measured and simulated"
        + (" before and after the revision" if is_revised else "")
        + ". A simulation begins again at the measurement every "
        + f"{overlays['restart_seconds']:g} s."
    )
    drawing = _drawn(one, channel, overlays, height=LEAD_HEIGHT)
    return DrawingPart(_keys(one) + drawing, caption, is_wide=True) if drawing else None


def recording_section(overlays: OverlayRecord | None) -> list[Section]:
    """Returns every channel of every kept rollout; the first rollout is unfolded."""
    if overlays is None or not overlays["rollouts"]:
        return []
    parts: list[Part] = [
        TextPart(
            "Nominal: the middle of the priors. Fitted: the original model with its closest "
            "parameters. Revised: with the effects that were found. The lower drawings show "
            "simulation minus measurement."
        )
    ]
    for place, one in enumerate(overlays["rollouts"]):
        every = "".join(_drawn(one, name, overlays) for name in one["channels"])
        drawings = _keys(one) + every
        part = DrawingPart(drawings, f"{_rollout_words(one, overlays).capitalize()}.")
        parts.append(part if place == 0 else FoldedPart(f"Rollout {one['rollout']}", [part]))
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


def _drawn(one: Any, channel: str, overlays: OverlayRecord, **look: Any) -> str:
    series = dict(one["channels"][channel])
    if not _is_revised(series):
        series.pop("revised", None)
    unit = overlays["units"].get(channel, "")
    errors = [
        f"{name} {number(one['misfit'][name].get(channel))}"
        for name in MODELS
        if name in series and name in one["misfit"]
    ]
    note = f"RMSE: {', '.join(errors)}" if errors else ""
    words = channel.replace("_", " ")
    title = f"{words} [{unit}]" if unit else words
    return curve(one["time"], series, title=title, note=note, **look)


def _keys(one: Any) -> str:
    """Returns the legend of a rollout."""
    channels = one["channels"].values()
    shown = {name for series in channels for name in series}
    if not any(map(_is_revised, channels)):
        shown.discard("revised")
    return keys([name for name in ("measured", *MODELS) if name in shown])


def _is_revised(series: Mapping[str, Any]) -> bool:
    """Returns whether the revised model differs from the fitted one."""
    return "revised" in series and series.get("revised") != series.get("fitted")


def _gain(misfit: Mapping[str, Mapping[str, Any]], channel: str) -> float:
    """Returns by what factor the revision lowers a channel's error."""
    before, after = (misfit.get(name, {}).get(channel) for name in ("fitted", "revised"))
    if before is None or after is None or not math.isfinite(before) or after <= 0.0:
        return 0.0
    return before / after


def _rollout_words(one: Mapping[str, Any], overlays: OverlayRecord) -> str:
    return f"{'held-out ' if overlays['is_held_out'] else ''}rollout {one['rollout']}"


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
