"""Measured and simulated channels of ``overlays.json`` as drawings."""

import math
from collections.abc import Mapping
from typing import Any

from npdr_ppl.drawing.curves_html import curve, keys
from npdr_ppl.drawing.numbers import number

__all__ = ["MODELS", "channel_html", "lead_html", "legend_html", "rollout_words"]

LEAD_HEIGHT = 150
"""Height in CSS pixels of the drawing at the top, so that verdict, curves and bars fit on a screen
of 1280 by 800."""

MODELS = ("nominal", "fitted", "revised")
"""The middle of the priors; the original model's closest fit; that of the revised model."""

Overlays = Mapping[str, Any]
"""The content of ``overlays.json``."""


def lead_html(overlays: Overlays) -> tuple[str, str] | None:
    """Returns the channel on which the revision helps most, and a caption.

    Args:
        overlays: The content of ``overlays.json``.

    Returns:
        Drawing and caption; ``None`` if nothing was simulated.
    """
    if not overlays["rollouts"]:
        return None
    one = overlays["rollouts"][0]
    channel = max(one["channels"], key=lambda name: _gain(one["misfit"], name), default=None)
    if channel is None:
        return None
    drawing = channel_html(one, channel, overlays, height=LEAD_HEIGHT)
    if not drawing:
        return None
    is_revised = _is_revised(one["channels"][channel])
    caption = (
        f"{channel.replace('_', ' ')} of {rollout_words(one, overlays)}, measured and simulated"
        + (" before and after the revision" if is_revised else "")
        + ". A simulation begins again at the measurement every "
        + f"{overlays['restart_seconds']:g} s."
    )
    return legend_html(one) + drawing, caption


def channel_html(
    one: Mapping[str, Any], channel: str, overlays: Overlays, *, height: int | None = None
) -> str:
    """Draws one channel of a rollout, with the models' errors in the heading.

    Args:
        one: An entry of ``rollouts``.
        channel: The channel.
        overlays: The content of ``overlays.json``.
        height: Height in CSS pixels, if not the usual one.
    """
    found = one["channels"][channel]
    names = [name for name in ("measured", *MODELS) if name in found]
    if not _is_revised(found) and "revised" in names:
        names.remove("revised")
    series = {name: found[name] for name in names}
    errors = {name: found[f"{name}_error"] for name in names if f"{name}_error" in found}
    unit = overlays["units"].get(channel, "")
    sizes = [
        f"{name} {number(one['misfit'][name].get(channel))}"
        for name in MODELS
        if name in series and name in one["misfit"]
    ]
    note = f"RMSE: {', '.join(sizes)}" if sizes else ""
    words = channel.replace("_", " ")
    title = f"{words} [{unit}]" if unit else words
    look = {} if height is None else {"height": height}
    return curve(one["time"], series, title=title, errors=errors, note=note, **look)


def legend_html(one: Mapping[str, Any]) -> str:
    """Returns the legend of a rollout.

    Args:
        one: An entry of ``rollouts``.
    """
    channels = one["channels"].values()
    shown = {name for series in channels for name in series}
    if not any(map(_is_revised, channels)):
        shown.discard("revised")
    return keys([name for name in ("measured", *MODELS) if name in shown])


def rollout_words(one: Mapping[str, Any], overlays: Overlays) -> str:
    """Returns a rollout's name; those held out are counted from 0 by themselves."""
    return f"rollout {one['rollout']}{' of those held out' if overlays['is_held_out'] else ''}"


def _is_revised(series: Mapping[str, Any]) -> bool:
    """Returns whether the revised model differs from the fitted one."""
    return "revised" in series and series.get("revised") != series.get("fitted")


def _gain(misfit: Mapping[str, Mapping[str, Any]], channel: str) -> float:
    """Returns by what factor the revision lowers a channel's error."""
    before, after = (misfit.get(name, {}).get(channel) for name in ("fitted", "revised"))
    if before is None or after is None or not math.isfinite(before) or after <= 0.0:
        return 0.0
    return before / after
