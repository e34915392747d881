"""Encoders' counts, read off the readings themselves.

Rounding moves no reading in any direction on average, so it is noise to a fit. A fit that rounds
its own simulation follows the noise instead: of many initial states some round in the recording's
favour, by chance, and nothing that is inferred beside them is worth much.
"""

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.rollouts import Rollouts

__all__ = ["Count", "count_of", "counts"]

RESOLUTION = 5e-7
"""Least step between readings relative to the greatest one; single precision has steps of 6e-8."""

NEARLY = 0.1
"""Share of a count by which readings in whole counts may be off, as decimals are."""


@dataclass(frozen=True)
class Count:
    """A channel's readings are whole multiples of something.

    Attributes:
        size: Of what, in the channel's unit.
        share: Share of the variance of what a model leaves in the channel that rounding to it
            makes.
    """

    size: float
    share: float

    def to_dict(self) -> dict[str, float]:
        """Returns JSON-serialisable values."""
        return asdict(self)


def counts(hypothesis: Hypothesis, rollouts: Rollouts) -> dict[str, Count]:
    """Returns the counts of the channels that have any, by channel.

    Args:
        hypothesis: A fitted model, whose residuals they are compared with.
        rollouts: The recording.
    """
    found = {}
    left = dict(zip(hypothesis.segments.channel_names, hypothesis.fit.scale.tolist(), strict=True))
    for name, scale in left.items():
        column = rollouts.channel_names.index(name)
        size = count_of(np.concatenate([values[:, column] for values in rollouts.readings]))
        if size is not None:
            found[name] = Count(size, size**2 / 12.0 / scale**2)
    return found


def count_of(readings: NDArray[np.floating]) -> float | None:
    """Returns the greatest step of which all readings are multiples, up to a common offset.

    Args:
        readings: Readings of one channel, ``(N,)``.

    Returns:
        ``None`` if they are multiples of nothing that single precision resolves.
    """
    levels = np.unique(readings.astype(np.float64))
    steps = np.diff(levels)
    steps = steps[steps > RESOLUTION * np.abs(levels).max()]
    if not len(steps):
        return None
    # All steps together have more digits than the least one.
    count = float(steps.sum() / np.round(steps / steps.min()).sum())
    multiples = (levels - levels[0]) / count
    return count if bool(np.all(np.abs(multiples - np.round(multiples)) < NEARLY)) else None
