"""Settings of a search for missing effects."""

from dataclasses import dataclass
from typing import Literal

from npdr_ppl.errors import DataError
from npdr_ppl.language.effects import Effect

__all__ = ["DiscoveryOptions"]


@dataclass(frozen=True)
class DiscoveryOptions:
    """Settings of a search for missing effects.

    How the recording is prepared is not among them; see
    :class:`~npdr_ppl.preparation.data_options.DataOptions`.

    Attributes:
        effects: The effects to search; ``None`` for every effect of the catalogue at every port
            where it makes sense.
        max_effects: Greatest number of effects to add; one law at three joints or more is one.
        false_alarm_rate: Probability that an alarm fires although nothing is missing.
        confidence: Probability above which one cause is named.
        repeat: Whether a half of the recording must show each effect, and no part of it may
            contradict it: neither half nor, with three rollouts or more, all but one rollout.
            Otherwise it is not named.
        learn: Whether a law is learned if no effect of the catalogue explains the recording.
        symmetry: Symmetry of a law that is learned: ``"odd"`` if mirrored motion and commands
            mirror it, ``"even"`` if they do not change it, ``None`` if it may have none.
        is_passive: Whether a law that is learned takes energy from its joint at every moment, as
            friction does.
        time_limit: Seconds after which no further effect is searched; ``None`` for no limit. The
            running step is finished. Then the effects found so far are compared with their
            alternatives, and the posterior and the held-out gap are computed. The verdict is
            ``unknown``, with the best explanation so far.
    """

    effects: tuple[Effect, ...] | None = None
    max_effects: int = 5
    false_alarm_rate: float = 0.01
    confidence: float = 0.9
    repeat: bool = True
    learn: bool = False
    symmetry: Literal["odd", "even"] | None = None
    is_passive: bool = False
    time_limit: float | None = None

    def __post_init__(self) -> None:
        """Checks that the numbers are in range.

        Raises:
            DataError: A number is out of range.
        """
        if self.max_effects < 0:
            raise DataError(f"max_effects must not be negative, got {self.max_effects}.")
        if self.symmetry not in (None, "odd", "even"):
            raise DataError(f"symmetry is 'odd', 'even' or None, got {self.symmetry!r}.")
        if not self.learn and (self.symmetry is not None or self.is_passive):
            raise DataError("symmetry and is_passive are those of a learned law; set learn=True.")
        for name in ("false_alarm_rate", "confidence"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise DataError(f"{name} must lie between 0 and 1, got {value}.")
        if self.time_limit is not None and not self.time_limit > 0.0:
            raise DataError(f"time_limit is a number of seconds, got {self.time_limit}.")
