"""Problems of the data that no physics explains, to be ruled out first.

A recording in degrees, with a sign turned round or its commands stamped too late looks like a
device with a missing effect, and a large catalogue will offer one. Each such problem has a remedy
that can be tried: the recording is changed back and the model fitted again. A remedy that makes
most of the misfit disappear names the problem.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.errors import NpdrError
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.workflows.binding import BindingOptions
from npdr_ppl.workflows.discovery.hypothesis import Hypothesis, fit_hypothesis

__all__ = ["data_problems"]

GROSS = 0.3
"""Residual in units of what a window's readings change by, above which remedies are tried."""

CURE = 0.5
"""By which factor a remedy has to reduce the residual to name the problem."""

SHIFTS = (-8, -4, -2, -1)
"""Steps by which commands may be stamped too late: no delay of a device does that."""

SPIKE = 12.0
"""Jumps, in standard deviations of a channel's second differences, that tell lost samples."""

MIN_STEPS = 20

MOST_LOST = 0.02
"""Share of the steps above which jumps are how the device moves."""

Array = NDArray[np.float64]


def data_problems(
    hypothesis: Hypothesis, rollouts: Rollouts, options: BindingOptions
) -> list[str]:
    """Returns problems of a recording, a sentence each.

    Args:
        hypothesis: The model, fitted to the recording.
        rollouts: The recording.
        options: Its segments.
    """
    return [
        *_lost_samples(rollouts, hypothesis.segments.channel_names),
        *_wrong_readings(hypothesis, rollouts, options),
    ]


def _wrong_readings(
    hypothesis: Hypothesis, rollouts: Rollouts, options: BindingOptions
) -> list[str]:
    present = _relative_misfit(hypothesis)
    if present < GROSS:
        return []
    cured: dict[str, float] = {}
    for problem, changed in _remedies(hypothesis, rollouts):
        try:
            tried = fit_hypothesis(
                hypothesis.model, changed, options, max_steps=6, max_rescalings=1
            )
        except NpdrError:
            continue
        cured[problem] = _relative_misfit(tried)
    if not cured:
        return []
    best = min(cured, key=lambda problem: cured[problem])
    return [best] if cured[best] < CURE * present else []


def _relative_misfit(hypothesis: Hypothesis) -> float:
    """Returns the residual in units of what windows' readings change by, the mean channel's."""
    segments = hypothesis.segments
    mask = segments.inputs.mask[..., None]
    names = segments.inputs.channel_names
    columns = [names.index(name) for name in segments.channel_names]
    change = segments.observed - segments.inputs.initial_values[:, None, columns]
    spread = ((change * mask).square().sum((0, 1)) / mask.sum()).sqrt().double()
    ratio = hypothesis.fit.scale / spread.clamp_min(1e-12)
    return float(ratio.clamp_max(10.0).log().mean().exp())


def _remedies(hypothesis: Hypothesis, rollouts: Rollouts) -> list[tuple[str, Rollouts]]:
    units = {sensor.name: sensor.unit for sensor in hypothesis.simulator.sensors}
    result = []
    for name in hypothesis.segments.channel_names:
        result.append((f"The sign of {name} looks turned round.", _scaled(rollouts, name, -1.0)))
        if units[name].startswith("rad"):
            degrees = math.pi / 180.0
            text = f"{name} looks recorded in degrees, not in {units[name]}."
            result.append((text, _scaled(rollouts, name, degrees)))
    for k, name in enumerate(rollouts.action_names):
        actions = [_column(a, k, lambda x: -x) for a in rollouts.actions]
        text = f"The sign of {name} looks turned round."
        result.append((text, replace(rollouts, actions=tuple(actions))))
    for shift in SHIFTS:
        text = f"The commands look stamped {-shift} steps too late."
        result.append((text, _earlier(rollouts, -shift)))
    return result


def _scaled(rollouts: Rollouts, channel: str, factor: float) -> Rollouts:
    k = rollouts.channel_names.index(channel)
    readings = [_column(r, k, lambda x: factor * x) for r in rollouts.readings]
    return replace(rollouts, readings=tuple(readings))


def _column(values: Array, k: int, change: Callable[[Array], Array]) -> Array:
    result = values.copy()
    result[:, k] = change(result[:, k])
    return result


def _earlier(rollouts: Rollouts, steps: int) -> Rollouts:
    """Returns the recording with every command given some steps earlier."""
    actions = [np.concatenate((a[steps:], np.repeat(a[-1:], steps, 0))) for a in rollouts.actions]
    return replace(rollouts, actions=tuple(actions))


def _lost_samples(rollouts: Rollouts, channels: tuple[str, ...]) -> list[str]:
    """Finds moments at which most channels jump at once and go on as if nothing had happened."""
    columns = [rollouts.channel_names.index(name) for name in channels]
    problems = []
    for index, readings in enumerate(rollouts.readings):
        first = np.diff(readings[:, columns], axis=0)
        # Only what moves can jump; an encoder's count is no jump.
        steady = np.median(np.abs(first), axis=0)
        second = np.abs(np.diff(first, axis=0))
        spread = np.maximum(np.median(second, axis=0) / 0.6745, 0.1 * steady)
        moving = steady > 0
        if len(second) < MIN_STEPS or moving.sum() < 2:
            continue
        jumps = second[:, moving] > SPIKE * spread[moving]
        together = jumps.mean(1) > 0.5
        count = int((np.diff(together.astype(int), prepend=0) == 1).sum())
        if 0 < count < MOST_LOST * len(second):
            begin = float(np.flatnonzero(together)[0] + 1) * rollouts.time_step
            problems.append(
                f"Rollout {index} looks as if samples were lost {count} times, first at "
                f"{begin:.3g} s."
            )
    return problems
