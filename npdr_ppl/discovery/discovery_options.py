"""Settings of a discovery."""

from dataclasses import dataclass
from typing import Literal

from npdr_ppl.errors import DataError
from npdr_ppl.language.effects import Effect
from npdr_ppl.preparation.data_options import (
    FEWEST_SEGMENTS,
    FEWEST_STEPS,
    DataOptions,
    default_segment_length,
)
from npdr_ppl.rollouts import Rollouts

__all__ = ["DiscoveryOptions"]


@dataclass(frozen=True)
class DiscoveryOptions:
    """Settings of a search for missing effects.

    Attributes:
        segment_length: Steps per segment; ``None`` for
            :func:`~npdr_ppl.preparation.binding.default_segment_length`.
        effects: The effects to search; ``None`` for every effect of the catalogue at every port
            where it makes sense.
        max_effects: Greatest number of effects to add.
        false_alarm_rate: Probability that an alarm fires although nothing is missing.
        confidence: Probability above which one cause is named.
        precision: Floating-point precision of the simulation.
        seed: Seed of all random numbers.
    """

    segment_length: int | None = None
    effects: tuple[Effect, ...] | None = None
    max_effects: int = 5
    false_alarm_rate: float = 0.01
    confidence: float = 0.9
    precision: Literal["float64", "float32"] = "float64"
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks that the numbers are in range.

        Raises:
            DataError: A number is out of range.
        """
        if self.segment_length is not None and self.segment_length < 2:
            raise DataError(f"segment_length must be at least 2 steps, got {self.segment_length}.")
        if self.max_effects < 0:
            raise DataError(f"max_effects must not be negative, got {self.max_effects}.")
        for name in ("false_alarm_rate", "confidence"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise DataError(f"{name} must lie between 0 and 1, got {value}.")

    def binding(self, rollouts: Rollouts) -> DataOptions:
        """Returns how a recording is cut into segments.

        Raises:
            DataError: The recording is too short.
        """
        length, fewest = self.segment_length, self.segment_length
        if length is None or fewest is None:
            length, fewest = default_segment_length(rollouts), FEWEST_STEPS
        if sum(rollouts.lengths) < FEWEST_SEGMENTS * fewest:
            raise DataError(
                f"{sum(rollouts.lengths)} steps are too few for {FEWEST_SEGMENTS} segments of "
                f"{fewest} steps; record more, or choose a shorter segment_length."
            )
        return DataOptions(None, length, "uncertain", self.precision)
