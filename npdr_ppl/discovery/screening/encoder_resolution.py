"""The encoder resolution of each channel, determined from the measurements themselves.

On average, rounding moves measurements in no direction, so a fit can treat it as noise. A fit that
rounds its own simulation follows this noise instead: by chance, some of many initial states round
as in the recording, and the parameters inferred with them are not reliable.
"""

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.discovery.screening.settings import ENCODER
from npdr_ppl.rollouts import Rollouts

__all__ = ["Count", "count_of", "counts"]


@dataclass(frozen=True)
class Count:
    """The encoder resolution of a channel, whose measurements are whole multiples of it.

    Attributes:
        size: The resolution, in the channel's unit.
        share: Share of the variance of the channel's residuals that rounding causes.
    """

    size: float
    share: float

    def to_dict(self) -> dict[str, float]:
        """Returns JSON-serialisable values."""
        return asdict(self)


def counts(hypothesis: Hypothesis, rollouts: Rollouts) -> dict[str, Count]:
    """Returns the encoder resolution by channel, for the channels that have one.

    Args:
        hypothesis: A fitted model, whose residuals the rounding is compared with.
        rollouts: The recording.
    """
    found = {}
    left = dict(zip(hypothesis.segments.channel_names, hypothesis.fit.scale.tolist(), strict=True))
    for name, scale in left.items():
        column = rollouts.channel_names.index(name)
        size = count_of(np.concatenate(rollouts.measurements(column)))
        if size is not None:
            found[name] = Count(size, size**2 / 12.0 / scale**2)
    return found


def count_of(readings: NDArray[np.floating]) -> float | None:
    """Returns the largest step of which all measurements are multiples, up to a common offset.

    Args:
        readings: Measurements of one channel, ``(N,)``.

    Returns:
        ``None`` if there is no such step that single precision resolves.
    """
    levels = np.unique(readings.astype(np.float64))
    steps = np.diff(levels)
    steps = steps[steps > ENCODER.least_resolution * np.abs(levels).max()]
    if not len(steps):
        return None
    # The sum of all steps gives more digits than the smallest step.
    count = float(steps.sum() / np.round(steps / steps.min()).sum())
    multiples = (levels - levels[0]) / count
    return (
        count
        if bool(np.all(np.abs(multiples - np.round(multiples)) < ENCODER.multiple_tolerance))
        else None
    )
