"""The time after which a search ends with the best answer so far."""

import math
import time
from collections.abc import Callable

__all__ = ["Deadline"]


class Deadline:
    """A time after which a search tries nothing further.

    Args:
        seconds: Seconds from now; ``None`` for no limit.
        clock: Returns the time in s.

    Attributes:
        has_stopped: Whether anything was left undone because the time was over.
    """

    def __init__(
        self, seconds: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._end = math.inf if seconds is None else clock() + seconds
        self.has_stopped = False

    def stops(self) -> bool:
        """Returns whether the time is over, and remembers that something is left undone."""
        self.has_stopped = self.has_stopped or self._clock() >= self._end
        return self.has_stopped
