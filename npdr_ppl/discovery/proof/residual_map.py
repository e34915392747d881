"""Where simulation and data disagree: the windows with the fitted model's largest residuals."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.states import measurement_noise

__all__ = [
    "Spot",
    "noise_of",
    "residuals_by_rollout",
    "standardised",
    "thinned",
    "worst_windows",
]

NUM_SPOTS = 10


@dataclass(frozen=True)
class Spot:
    """A window with a large residual.

    Attributes:
        rollout: Index of the rollout.
        time_span: Start and end, in seconds from the rollout's beginning.
        channel: The channel with the largest residual.
        region: Ranges of the states and commands in the window, in words.
        z: Root-mean-square residual of the channel, in standard deviations of the noise.
    """

    rollout: int
    time_span: tuple[float, float]
    channel: str
    region: str
    z: float

    def to_dict(self) -> dict[str, object]:
        """Returns JSON-serialisable values."""
        return {
            "rollout": self.rollout,
            "time_span": list(self.time_span),
            "channel": self.channel,
            "region": self.region,
            "z": self.z,
        }


def standardised(hypothesis: Hypothesis, rollouts: Rollouts) -> Tensor:
    """Returns residuals in standard deviations of the measurement noise, ``(S, K, C)``.

    The initial states are fitted, so that the residuals are errors of the model.

    Args:
        hypothesis: The fitted model.
        rollouts: The recording it was fitted to.
    """
    segments, fit = hypothesis.segments, hypothesis.fit
    noise = measurement_noise(rollouts.series(segments.channel_names)).clamp_min(1e-9)
    flat = segments.residuals(fit.z[None], fit.offsets[None], noise)[0]
    return flat.unflatten(-1, (-1, len(noise)))


def worst_windows(hypothesis: Hypothesis, rollouts: Rollouts) -> list[Spot]:
    """Returns the windows with the largest residuals, the worst first.

    Args:
        hypothesis: The fitted model.
        rollouts: The recording it was fitted to.
    """
    inputs, names = hypothesis.segments.inputs, hypothesis.segments.channel_names
    residual = standardised(hypothesis, rollouts)
    count = inputs.mask.sum(-1).clamp_min(1)
    z = (residual.square().sum(1) / hypothesis.segments.num_measured.clamp_min(1)).sqrt()
    worst, channel = z.max(-1)
    spots = []
    for row in worst.argsort(descending=True)[:NUM_SPOTS].tolist():
        start = int(inputs.start[row]) * inputs.time_step
        spots.append(
            Spot(
                int(inputs.rollout[row]),
                (start, start + int(count[row]) * inputs.time_step),
                names[int(channel[row])],
                _region(hypothesis, row),
                float(worst[row]) if math.isfinite(float(worst[row])) else math.inf,
            )
        )
    return spots


def _region(hypothesis: Hypothesis, row: int) -> str:
    """Describes the ranges of states and commands in a window."""
    segments = hypothesis.segments
    inputs = segments.inputs
    mask = inputs.mask[row]
    parts = [
        f"{name} {_range(segments.observed[row, mask, k])}"
        for k, name in enumerate(segments.channel_names)
    ]
    parts += [
        f"{name} {_range(inputs.actions[row, mask, k])}"
        for k, name in enumerate(inputs.action_names)
    ]
    return ", ".join(parts)


def _range(values: Tensor) -> str:
    low, high = float(torch.amin(values)), float(torch.amax(values))
    return f"{low:.3g} to {high:.3g}"


def noise_of(hypothesis: Hypothesis) -> Tensor:
    """Returns the standard deviation of each channel's measurement noise, ``(C,)``."""
    segments = hypothesis.segments
    series = [o[m] for o, m in zip(segments.observed, segments.inputs.mask, strict=True)]
    return measurement_noise(series).clamp_min(1e-9)


def residuals_by_rollout(hypothesis: Hypothesis, noise: Tensor) -> dict[int, NDArray[np.float64]]:
    """Returns |residual| in units of noise, ``(T, C)`` by rollout; NaN outside the segments.

    Args:
        hypothesis: The fitted model.
        noise: Standard deviation of each channel's noise, ``(C,)``.
    """
    segments, fit = hypothesis.segments, hypothesis.fit
    residual = segments.residuals(fit.z[None], fit.offsets[None], noise)[0]
    z = residual.unflatten(-1, (-1, len(noise))).abs()
    inputs = segments.inputs
    starts, counts = inputs.start.tolist(), inputs.mask.sum(-1).tolist()
    found = {}
    for rollout in inputs.rollout.unique().tolist():
        rows = torch.nonzero(inputs.rollout == rollout)[:, 0].tolist()
        length = max(starts[row] + counts[row] for row in rows)
        values = np.full((length, len(noise)), np.nan)
        for row in rows:
            values[starts[row] : starts[row] + counts[row]] = z[row, : counts[row]].numpy()
        found[rollout] = values
    return found


def thinned(values: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Returns the root mean square over the steps of each cell, ``(cells, C)``.

    Args:
        values: Values by step, ``(T, C)``; NaN where there is none.
        most: Greatest number of cells.
    """
    width = -(-len(values) // most)
    padding = -len(values) % width
    padded = np.concatenate((values, np.full((padding, values.shape[1]), np.nan)))
    cells = padded.reshape(-1, width, values.shape[1])
    count = np.isfinite(cells).sum(1)
    total = np.nansum(cells**2, axis=1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))
