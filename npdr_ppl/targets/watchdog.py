"""A watchdog: stops a device whose control loop has gone silent."""

import math
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

__all__ = ["Watchdog"]


class Watchdog:
    """Calls a function from another thread if it is not fed for a while, at most once.

    The first feeding arms it. It notices a controller or a driver that waits forever, but not a
    process that has died or been suspended: it does not replace the watchdog in the device.

    Args:
        timeout: Silence that it tolerates, in s; it may take a quarter longer to notice.
        bark: What to call.
    """

    def __init__(self, timeout: float, bark: Callable[[], None]) -> None:
        self._timeout = timeout
        self._bark = bark
        self._fed_at = math.inf
        self._is_done = threading.Event()
        self._has_barked = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    @property
    def has_barked(self) -> bool:
        """Whether the loop has been silent for too long."""
        return self._has_barked.is_set()

    def feed(self) -> None:
        """Tells that the loop is alive."""
        self._fed_at = time.monotonic()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_done.set()
        # Not forever: a device whose stop hangs must not keep the loop from its own clean-up.
        self._thread.join(self._timeout)

    def _watch(self) -> None:
        # Waking now and then costs the loop less than being woken by it in each step.
        while not self._is_done.wait(self._timeout / 4.0):
            if time.monotonic() - self._fed_at > self._timeout:
                self._has_barked.set()
                self._bark()
                return
