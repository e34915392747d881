"""A recording and the simulations of it by three models, for pictures and reports."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.proof.estimated_anew import EstimatedAnew
from npdr_ppl.discovery.proof.residual_map import noise_of, residuals_by_rollout, thinned
from npdr_ppl.drawing.overlay_html import MODELS
from npdr_ppl.errors import NpdrError
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts, stitch

__all__ = ["Overlay", "Overlays", "ResidualMap", "overlay"]

RESTART_SECONDS = 2.0
"""Time in s after which a simulation starts again from the measurement. It is ten times the
default segment of the search, so that differences grow until they are visible. Without restarts, a
pendulum that swings over leaves the measurement after a few seconds with any parameters."""

MOST_ROLLOUTS = 3
"""Maximum number of rollouts that are kept; those that the fitted model misses most come first."""

MOST_POINTS = 600
"""Maximum number of points of a series, more than a page is wide in CSS pixels: a longer one keeps
the smallest and the largest value of each of half as many stretches."""

MOST_CELLS = 120
"""Maximum number of cells of a residual map along time; each is about 7 CSS pixels wide."""

MOST_NUMBERS = 120_000
"""Maximum number of points of all curves, which a robot of many channels shares; and three times
the maximum of cells of all maps. ``overlays.json`` may have 200 000 values to be read back."""

FEWEST_POINTS = 150
"""Least number of points of a series with which a second rollout is kept."""

WITH_ERRORS = ("fitted", "revised")
"""Models whose errors are kept beside their simulations. They are thinned by themselves: the
difference of two thinned series would be that of measurements at different times."""

DIGITS = 8
"""Significant digits of the values: an angle of 3 rad keeps errors of 1e-7 rad, below the
resolution of encoders."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Overlay:
    """One rollout and simulations of it.

    Attributes:
        rollout: Index of the rollout.
        time: Seconds from the rollout's beginning, ``(T,)``; stretches that were left out as
            unusable take no time.
        measured: Measurements, ``(T, C)``.
        simulated: Simulations by model, ``(T, C)`` each; not finite where one failed.
        misfit: Root-mean-square error of each model by channel, in the channel's unit.
    """

    rollout: int
    time: Array
    measured: Array
    simulated: dict[str, Array]
    misfit: dict[str, dict[str, float]]

    def to_dict(self, channels: Sequence[str], most: int = MOST_POINTS) -> dict[str, Any]:
        """Returns JSON-serialisable values, thinned.

        Args:
            channels: Names of the C channels.
            most: Greatest number of points of a series.
        """
        series = {"measured": self.measured, **self.simulated}
        series |= {
            f"{name}_error": self.simulated[name] - self.measured
            for name in WITH_ERRORS
            if name in self.simulated
        }
        return {
            "rollout": self.rollout,
            "time": _rounded(_thinned_time(self.time, most)),
            "channels": {
                channel: {name: _rounded(_extremes(v[:, k], most)) for name, v in series.items()}
                for k, channel in enumerate(channels)
            },
            "misfit": self.misfit,
        }


@dataclass(frozen=True)
class ResidualMap:
    """Residuals of a rollout by channel and time, in standard deviations of the noise.

    Attributes:
        rollout: Index of the rollout.
        seconds: Duration in s.
        before: Root mean square of the original model's residuals by cell, ``(cells, C)``.
        after: The same of the revised model.
    """

    rollout: int
    seconds: float
    before: Array
    after: Array

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values, with one row per channel."""
        return {
            "rollout": self.rollout,
            "seconds": self.seconds,
            "before": [_rounded(row) for row in self.before.T],
            "after": [_rounded(row) for row in self.after.T],
        }


@dataclass(frozen=True)
class Overlays:
    """Pictures of a recording: what was measured and what the models make of it.

    Attributes:
        is_held_out: Whether the models were not fitted to these rollouts.
        channels: Names of the channels.
        units: Their units by name.
        rollouts: The rollouts that the fitted model misses most.
        maps: Residuals along the recording that was searched.
    """

    is_held_out: bool
    channels: tuple[str, ...]
    units: dict[str, str]
    rollouts: tuple[Overlay, ...]
    maps: tuple[ResidualMap, ...]

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values, the content of ``overlays.json``."""
        lines = max(1, len(self.channels) * (1 + len(MODELS) + len(WITH_ERRORS)))
        kept = max(1, min(len(self.rollouts), MOST_NUMBERS // (lines * FEWEST_POINTS)))
        points = max(2, min(MOST_POINTS, MOST_NUMBERS // (lines * kept)))
        return {
            "is_held_out": self.is_held_out,
            "restart_seconds": RESTART_SECONDS,
            "channels": list(self.channels),
            "units": self.units,
            "rollouts": [one.to_dict(self.channels, points) for one in self.rollouts[:kept]],
            "maps": [shown.to_dict() for shown in self.maps],
        }


def overlay(
    before: Hypothesis,
    after: Hypothesis,
    searched: Hypothesis,
    rollouts: Rollouts,
    options: DataOptions,
    *,
    is_held_out: bool,
    anew: EstimatedAnew | None = None,
) -> Overlays:
    """Simulates a recording with the nominal, the fitted and the revised model.

    Every simulation starts again from the measurement after ``RESTART_SECONDS``, or at the end of
    a rollout or stretch.

    Args:
        before: The original model, fitted.
        after: The revised model, fitted.
        searched: The original model as the search began, along the recording of the residual map.
        rollouts: The rollouts to simulate.
        options: How recordings are prepared.
        is_held_out: Whether these rollouts were not used to fit the models.
        anew: Parameters of the revised model that were estimated anew on these rollouts. As in the
            gap, each half is simulated with the values of the other half.
    """
    steps = max(2, round(RESTART_SECONDS / rollouts.time_step))
    options = replace(options, segment_length=min(steps, max(rollouts.lengths)))
    nominal = torch.zeros_like(before.fit.z)
    segments = SegmentModel(before.model, rollouts, options, is_complete=True)
    # Several parameters of a model take hardly longer than one.
    made = [
        *_simulated(before, torch.stack((nominal, before.fit.z)), rollouts, options),
        *_simulated(after, after.fit.z[None], rollouts, options, anew),
    ]
    series = dict(zip(MODELS, made, strict=True))
    measured = [s.double().numpy() for s in rollouts.series(segments.channel_names)]
    channels = segments.channel_names
    # A rollout that was left out, such as the copy of another one, has no segments.
    used = torch.unique(segments.inputs.rollout).tolist()
    found = []
    for row, place in enumerate(used):
        values = measured[place]
        shown = {name: made[row] for name, made in series.items() if made is not None}
        if any(made.shape != values.shape for made in shown.values()):
            continue
        time = np.arange(len(values), dtype=np.float64) * rollouts.time_step
        misfit = {name: _misfit(made, values, channels) for name, made in shown.items()}
        found.append(Overlay(place, time, values, shown, misfit))
    found.sort(key=lambda one: _missed(one, [measured[k] for k in used]), reverse=True)
    units = {s.name: s.unit for s in segments.measured}
    maps = _maps(searched, after)
    return Overlays(is_held_out, channels, units, tuple(found[:MOST_ROLLOUTS]), maps)


def _simulated(
    hypothesis: Hypothesis,
    z: Tensor,
    rollouts: Rollouts,
    options: DataOptions,
    anew: EstimatedAnew | None = None,
) -> list[list[Array] | None]:
    """Returns the simulated series ``(T, C)`` of each rollout for each parameters, ``(n, d)``.

    ``None`` if the simulator fails.
    """
    try:
        segments = SegmentModel(hypothesis.model, rollouts, options, is_complete=True)
        offsets = segments.no_offsets.expand(len(z), -1, -1)
        if anew is None:
            made = segments.simulate(z, offsets).double()
        else:
            num = segments.inputs.num_segments
            made = anew.simulate(
                segments, z, offsets, torch.arange(num) >= (num + 1) // 2
            ).double()
    except NpdrError:
        if len(z) == 1:
            return [None]
        return [_simulated(hypothesis, one[None], rollouts, options, anew)[0] for one in z]
    return [
        [s.numpy() for s in stitch(one, segments.inputs, segments.channel_names)] for one in made
    ]


def _misfit(made: Array, measured: Array, channels: Sequence[str]) -> dict[str, float]:
    # A simulation that failed is infinite or not a number, and so is its error.
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.sqrt(np.mean((made - measured) ** 2, axis=0))
    return dict(zip(channels, error.tolist(), strict=True))


def _missed(one: Overlay, measured: Sequence[Array]) -> float:
    """Returns the fitted model's error in a rollout, relative to each channel's range."""
    low = np.min([values.min(0) for values in measured], axis=0)
    high = np.max([values.max(0) for values in measured], axis=0)
    errors = np.array(list(one.misfit.get("fitted", {}).values()))
    if not len(errors) or not np.isfinite(errors).all():
        return float("inf")
    return float((errors / np.maximum(high - low, 1e-12)).mean())


def _maps(before: Hypothesis, after: Hypothesis) -> tuple[ResidualMap, ...]:
    noise = noise_of(before)
    found = [residuals_by_rollout(hypothesis, noise) for hypothesis in (before, after)]
    step = before.segments.inputs.time_step
    cells = max(2, min(MOST_CELLS, MOST_NUMBERS // (6 * MOST_ROLLOUTS * len(noise))))
    loud = sorted(found[0], key=lambda r: -float(np.nanmean(found[0][r] ** 2)))[:MOST_ROLLOUTS]
    return tuple(
        ResidualMap(
            rollout,
            len(found[0][rollout]) * step,
            *(thinned(values[rollout], cells) for values in found),
        )
        for rollout in loud
    )


def _extremes(values: Array, most: int) -> Array:
    """Returns the two extreme values of each stretch, in the order in which they occur."""
    width = _stretch(len(values), most)
    if width == 1:
        return values
    padded = np.concatenate([values, np.repeat(values[-1:], -len(values) % width)])
    rows = padded.reshape(-1, width)
    # What is not finite is no extreme; a stretch without any finite value stays a gap.
    is_known = np.isfinite(rows)
    lowest = np.where(is_known, rows, np.inf).argmin(1)
    highest = np.where(is_known, rows, -np.inf).argmax(1)
    ends = np.sort(np.stack([lowest, highest], 1), axis=1)
    return np.take_along_axis(rows, ends, 1).ravel()


def _thinned_time(time: Array, most: int) -> Array:
    """Returns the times of the first and the middle value of each stretch."""
    width = _stretch(len(time), most)
    if width == 1:
        return time
    starts = np.arange(0, len(time), width)
    middles = np.minimum(starts + width // 2, len(time) - 1)
    return time[np.stack([starts, middles], 1).ravel()]


def _stretch(num: int, most: int) -> int:
    """Returns the number of values of which two are kept; 1 if all are."""
    return 1 if num <= most else max(2, -(-2 * num // most))


def _rounded(values: Array) -> list[float | None]:
    """Returns numbers of ``DIGITS`` digits; ``None`` for what is not finite."""
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]
