"""Where simulation and data disagree: the windows with the fitted model's largest residuals."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.states import measurement_noise

__all__ = ["Spot", "standardised", "worst_windows"]

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
