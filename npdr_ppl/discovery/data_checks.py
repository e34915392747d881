"""Checks for errors in the recording itself, made before any effect is searched for.

A recording in degrees, with an inverted sign or with late time stamps of its commands looks like a
device with a missing effect, and a large catalogue will offer one. Each such problem has a remedy
that can be tried: the recording is corrected and the model is fitted again. If a remedy removes
most of the misfit, its problem is reported.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_hypothesis
from npdr_ppl.discovery.settings import DATA_CHECKS
from npdr_ppl.errors import DataError, NpdrError
from npdr_ppl.language.channels import Channel
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.simulator_checks import OTHER_UNITS, check_units

__all__ = ["data_problems", "recording_problems"]


Array = NDArray[np.float64]


def data_problems(hypothesis: Hypothesis, rollouts: Rollouts, options: DataOptions) -> list[str]:
    """Returns the problems of a recording, one sentence each.

    Args:
        hypothesis: The model, fitted to the recording.
        rollouts: The recording.
        options: How it is cut into segments.
    """
    return recording_problems(hypothesis.segments.measured, rollouts) or _wrong_readings(
        hypothesis, rollouts, options
    )


def recording_problems(sensors: Sequence[Channel], rollouts: Rollouts) -> list[str]:
    """Returns the problems that are visible without a simulation, one sentence each.

    Args:
        sensors: The model's description of the recorded channels.
        rollouts: The recording.
    """
    problems = _lost_samples(rollouts, [sensor.name for sensor in sensors])
    try:
        check_units(rollouts, sensors)
    except DataError as error:
        problems.append(str(error))
    return problems


def _wrong_readings(hypothesis: Hypothesis, rollouts: Rollouts, options: DataOptions) -> list[str]:
    # Fitted like the remedies, from the smoother's initial states: those of the present fit have
    # followed the wrong measurements.
    as_read = fit_hypothesis(hypothesis.model, rollouts, options, max_steps=6, is_rough=True)
    present = _relative_misfit(as_read)
    if present < DATA_CHECKS.large_residual:
        return []
    cured: dict[str, float] = {}
    for problem, changed in _remedies(hypothesis, rollouts):
        try:
            tried = fit_hypothesis(hypothesis.model, changed, options, max_steps=6, is_rough=True)
        except NpdrError:
            continue
        cured[problem] = _relative_misfit(tried)
    if not cured:
        return []
    best = min(cured, key=lambda problem: cured[problem])
    return [best] if cured[best] < DATA_CHECKS.remedy_factor * present else []


def _relative_misfit(hypothesis: Hypothesis) -> float:
    """Returns the residual relative to the measurements' change in windows, as a channel mean."""
    segments = hypothesis.segments
    mask = segments.inputs.mask[..., None]
    names = segments.inputs.channel_names
    columns = [names.index(name) for name in segments.channel_names]
    change = segments.observed - segments.inputs.initial_values[:, None, columns]
    spread = ((change * mask).square().sum((0, 1)) / mask.sum()).sqrt().double()
    ratio = hypothesis.fit.scale / spread.clamp_min(1e-12)
    return float(ratio.clamp_max(10.0).log().mean().exp())


def _remedies(hypothesis: Hypothesis, rollouts: Rollouts) -> Iterator[tuple[str, Rollouts]]:
    sensors = hypothesis.segments.measured
    units = {sensor.name: sensor.unit.removesuffix("/s") for sensor in sensors}
    pairs = [[s.rate_of, s.name] for s in sensors if s.rate_of in units]
    for group in [[name] for name in units] + pairs:
        text = f"The sign of {' and '.join(group)} looks inverted."
        yield text, _scaled(rollouts, group, -1.0)
    for si, (other, factor) in OTHER_UNITS.items():
        chosen = [name for name, unit in units.items() if unit == si]
        for group in [[name] for name in chosen] + ([chosen] if len(chosen) > 1 else []):
            looks = "look" if len(group) > 1 else "looks"
            sentence = f"{' and '.join(group)} {looks} recorded in {other}, not in SI units."
            yield sentence, _scaled(rollouts, group, 1.0 / factor)
    for k, name in enumerate(rollouts.action_names):
        actions = [_column(a, k, lambda x: -x) for a in rollouts.actions]
        text = f"The sign of {name} looks inverted."
        yield text, replace(rollouts, actions=tuple(actions))
    for steps in DATA_CHECKS.shifts:
        if 4 * steps < min(rollouts.lengths):
            yield (
                f"The time stamps of the commands look about {steps} steps too late.",
                _shifted(rollouts, steps),
            )
            if steps * rollouts.time_step > DATA_CHECKS.longest_delay:
                text = f"The time stamps of the commands look about {steps} steps too early."
                yield text, _shifted(rollouts, -steps)


def _scaled(rollouts: Rollouts, channels: Sequence[str], factor: float) -> Rollouts:
    factors = np.where([name in channels for name in rollouts.channel_names], factor, 1.0)
    return replace(rollouts, readings=tuple(values * factors for values in rollouts.readings))


def _column(values: Array, k: int, change: Callable[[Array], Array]) -> Array:
    result = values.copy()
    result[:, k] = change(result[:, k])
    return result


def _shifted(rollouts: Rollouts, steps: int) -> Rollouts:
    """Returns the recording with all commands moved some steps earlier, or later if negative."""
    size = abs(steps)

    def moved(actions: Array) -> Array:
        if steps > 0:
            return np.concatenate((actions[size:], np.repeat(actions[-1:], size, 0)))
        return np.concatenate((np.repeat(actions[:1], size, 0), actions[:-size]))

    return replace(rollouts, actions=tuple(moved(actions) for actions in rollouts.actions))


def _lost_samples(rollouts: Rollouts, channels: Sequence[str]) -> list[str]:
    """Finds times at which most channels jump at once and then continue as usual."""
    columns = [rollouts.channel_names.index(name) for name in channels]
    problems = []
    for index, readings in enumerate(rollouts.readings):
        first = np.diff(readings[:, columns], axis=0)
        second = np.abs(np.diff(first, axis=0))
        first = np.abs(first[1:])
        # Only steps in which the device moves: it may have rested most of the time.
        rests = first <= DATA_CHECKS.rest_change * np.sqrt(np.square(first).mean(0))
        moves = rests.mean(1) <= 0.5
        if moves.sum() < DATA_CHECKS.least_steps:
            continue
        # Only moving channels can jump; a step of the encoder resolution is no jump.
        moving = np.median(first[moves], axis=0) > 0
        if moving.sum() < 2:
            continue
        usual = _usual_change(first[moves], second[moves])
        # A swing-up beside seconds of balancing is no jump either, so compare with the steps near.
        near = _usual_change(first, second, size=2 * DATA_CHECKS.least_steps + 1)
        jumps = (second > DATA_CHECKS.jump_size * np.maximum(usual, near))[:, moving]
        together = jumps.mean(1) > 0.5
        count = int((np.diff(together.astype(int), prepend=0) == 1).sum())
        if 0 < count and together.mean() < DATA_CHECKS.most_lost:
            begin = float(np.flatnonzero(together)[0] + 1) * rollouts.time_step
            problems.append(
                f"Rollout {index} seems to have lost samples (number of gaps: {count}, the first "
                f"at {begin:.3g} s)."
            )
    return problems


def _usual_change(first: Array, second: Array, *, size: int | None = None) -> Array:
    """Returns the standard deviation of second differences in steady motion, by channel.

    Args:
        first: Absolute first differences, ``(T, C)``.
        second: Absolute second differences, ``(T, C)``.
        size: Number of steps around each step that count, for a result ``(T, C)``; ``None`` for
            all steps, ``(C,)``.
    """

    def median(values: Array) -> Array:
        if size is None:
            return np.median(values, axis=0)
        return ndimage.median_filter(values, size=(size, 1), mode="nearest")

    return np.maximum(median(second) / 0.6745, 0.1 * median(first))
